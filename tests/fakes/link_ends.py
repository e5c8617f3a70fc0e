"""A link of the wire in memory, and the requests that it brings to a listener.

See `tests.fakes.link`, which moves it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from fogft.link.port import Answer, LinkEvents, LinkStatus, Peer, Probe, ProbeAnswer
from fogft.link.window import LinkWindow
from fogft.link.zenoh.diagnosis import wrong_name
from fogft.link.zenoh.robot.probing import Silence
from fogft.model.refusal import Refusal
from fogft.model.replica import LinkState, doubted_after_s
from fogft.requests.load import Handling, Load

if TYPE_CHECKING:
    from tests.fakes.link import MemoryDialer, MemoryListener

_PROBE_EVERY_S = 1.0
_FIRST_PROBES_EVERY_S = 0.1


@dataclass
class _Attempt:
    service: str
    request_id: bytes
    payload: bytes
    deadline: float
    handling: Handling
    forgotten: bool = False

    @property
    def size(self) -> int:
        return len(self.payload)


class Session:
    """One connection between a link and a listener; used once."""

    def __init__(self, listener: MemoryListener) -> None:
        self.listener = listener
        self.window: LinkWindow[_Attempt] = LinkWindow()
        self.attempts: list[_Attempt] = []
        self.asked = Silence()
        self.ended = False


class MemoryLink:
    """A robot's connection to one replica; see `port.Link`."""

    def __init__(
        self, dialer: MemoryDialer, peer: Peer, services: Mapping[str, str], events: LinkEvents
    ) -> None:
        self._wire = dialer.wire
        self._dialer = dialer
        self._peer = peer
        self._services = dict(services)
        self._events = events
        self._session: Session | None = None
        self._silence = Silence()
        self._doubted = False
        self._next_probe = 0.0
        self._sessions = 0
        self._closed = False
        self._status = LinkStatus(
            LinkState.CONNECTING, None, None, 0.0, None, 0, 0, "not reached yet"
        )
        self._heard_at: float | None = None
        self._forgotten: dict[bytes, None] = {}

    @property
    def peer(self) -> Peer:
        """The replica at the other end."""
        return self._peer

    @property
    def usable(self) -> bool:
        """Whether requests may be offered."""
        return not self._closed and self._status.state is LinkState.UP

    @property
    def ready(self) -> frozenset[str]:
        """Services that the last probe answer called ready; empty unless UP."""
        answer = self._status.probe_answer
        return answer.ready if answer is not None and self.usable else frozenset()

    thin = False

    @property
    def leaving(self) -> bool:
        """Whether the replica is leaving."""
        answer = self._status.probe_answer
        return answer is not None and answer.draining

    def offer(
        self,
        service: str,
        request_id: bytes,
        payload: bytes,
        remaining_s: float,
        *,
        more: bool = False,
        handling: Handling = Handling.NORMAL,
    ) -> bool:
        """Take one attempt, or return False."""
        session = self._session
        if session is None or not self.usable or service not in self._services:
            return False
        deadline = self._wire.now + remaining_s
        attempt = _Attempt(service, request_id, payload, deadline, handling)
        if not session.window.admit(attempt):
            return False
        session.attempts.append(attempt)
        self._wire.post(session, lambda: self._arrive(session, attempt))
        return True

    def _arrive(self, session: Session, attempt: _Attempt) -> None:
        remaining_s = attempt.deadline - self._wire.now
        incoming = MemoryIncoming(
            attempt.service,
            attempt.request_id,
            self._dialer.robot,
            remaining_s,
            attempt.payload,
            handling=attempt.handling,
            send=lambda answer: self._wire.post(
                session, lambda: self._end(session, attempt, answer)
            ),
            listener=session.listener,
        )
        session.listener.request(self._services[attempt.service], incoming)

    def _end(self, session: Session, attempt: _Attempt, answer: Answer) -> None:
        if session.window.remove(attempt):
            session.attempts.remove(attempt)
            self._events.answered(self, replace(answer, service=attempt.service))
            if session.window.regained_room():
                self._events.changed(self)
            return
        self._forgotten.pop(attempt.request_id, None)
        self._events.late(self, replace(answer, service=attempt.service))

    def send(self) -> None:
        """Do nothing: it was sent."""

    def forget(self, request_id: bytes) -> None:
        """Free the window of a request."""
        session = self._session
        if session is not None and session.window.forget(request_id):
            self._forgotten[request_id] = None
            session.attempts = [a for a in session.attempts if a.request_id != request_id]
            if session.window.regained_room():
                self._events.changed(self)

    def flush(self) -> None:
        """Send cancellations for forgotten, unanswered requests."""
        session, ids = self._session, list(self._forgotten)
        self._forgotten.clear()
        if session is not None and ids:
            self._wire.post(session, lambda: session.listener.cancel(ids))

    def status(self) -> LinkStatus:
        """Return a snapshot."""
        now, session = self._wire.now, self._session
        return replace(
            self._status,
            heard_age_s=None if self._heard_at is None else now - self._heard_at,
            silent_for_s=self._silence.for_s(now),
            in_flight=len(session.window) if session else 0,
            reopened=max(self._sessions - 1, 0),
        )

    def close(self) -> None:
        """End the link; what is open is lost. Repeatable."""
        if not self._closed:
            self._closed = True
            self._part("closed")
            if self in self._wire.links:
                self._wire.links.remove(self)

    # -- time -----------------------------------------------------------------------------

    def tick(self) -> None:
        """Connect, probe, suspect, let attempts time out: what is due now."""
        now = self._wire.now
        if self._session is None:
            self._silence.began(now)
            self._connect()
        session = self._session
        if session is None:
            return
        for attempt in [a for a in session.attempts if a.deadline <= now]:
            self._end(session, attempt, Answer(attempt.request_id, refusal=Refusal.LOST))
        if session.asked.for_s(now) >= self._dialer.suspect_after_s:
            self._part(f"no probe answered for {self._dialer.suspect_after_s:g} s")
        elif now >= self._next_probe:
            every_s = min(_PROBE_EVERY_S, self._dialer.suspect_after_s / 2)
            self._next_probe = now + (every_s if self.usable else _FIRST_PROBES_EVERY_S)
            session.asked.began(now)
            self._silence.began(now)
            known = self._status.probe_answer
            describe = not self.usable or known is None or not known.types
            probe = Probe(self._dialer.robot, describe)
            self._wire.post(session, lambda: self._probed(session, probe, now))
        self._doubt(now)

    def _doubt(self, now: float) -> None:
        """Tell the owner, once a silence, that a probe's answer is late; it stays UP."""
        was = self._doubted
        self._doubted = self._silence.for_s(now) >= doubted_after_s(self._status.rtt_s)
        if self._doubted and not was and self.usable:
            self._events.changed(self)

    def _connect(self) -> None:
        listener = self._wire.at(self._peer.endpoint)
        if listener is None:
            self._say(f"`{self._peer.endpoint}`: connection refused")
        elif listener.frozen:
            self._say(f"`{self._peer.endpoint}` does not answer yet")
        elif listener.certificate_name != self._peer.certificate_name:
            self._say(wrong_name(listener.certificate_name, self._peer))
        else:
            self._session = Session(listener)
            self._sessions += 1
            self._next_probe = self._wire.now

    def _probed(self, session: Session, probe: Probe, sent_at: float) -> None:
        answer = session.listener.probe(probe)
        if answer is not None:
            self._wire.post(session, lambda: self._heard(session, answer, sent_at))

    def _heard(self, session: Session, answer: ProbeAnswer, sent_at: float) -> None:
        id = self._peer.id
        if (answer.slot, answer.generation) != (id.slot, id.generation):
            self._part(
                f"`{self._peer.endpoint}` identifies itself as {answer.slot}.{answer.generation}, "
                f"not {id.short}"
            )
            return
        known = self._status.probe_answer
        if not answer.types and known is not None and known.incarnation == answer.incarnation:
            answer = replace(answer, types=known.types)
        now = self._wire.now
        session.asked.ended()
        self._silence.ended()
        self._heard_at = now
        news = not self.usable or answer != self._status.probe_answer
        self._status = replace(
            self._status, state=LinkState.UP, probe_answer=answer, rtt_s=now - sent_at, detail=""
        )
        if news:
            self._events.changed(self)

    def lost(self, listener: MemoryListener) -> None:
        """The listener has ended: notice it, as a lost connection is noticed."""
        if self._session is not None and self._session.listener is listener:
            self._part("the connection was lost")

    def _part(self, because: str) -> None:
        session, self._session = self._session, None
        was_up = self._status.state is LinkState.UP
        state = LinkState.SUSPECT if was_up else self._status.state
        self._status = replace(self._status, state=state, detail=because)
        if session is None:
            return
        session.ended = True
        if not self._closed:
            self._silence.began(self._wire.now)
        for attempt in session.window.close():
            lost = Answer(attempt.request_id, refusal=Refusal.LOST, service=attempt.service)
            self._events.answered(self, lost)
        self._events.changed(self)

    def _say(self, detail: str) -> None:
        if detail != self._status.detail:
            self._status = replace(self._status, detail=detail)
            self._events.changed(self)


class MemoryIncoming:
    """A request at a listener in memory; see `port.Incoming`."""

    def __init__(
        self,
        service: str,
        request_id: bytes,
        robot: str,
        remaining_s: float,
        payload: bytes,
        *,
        handling: Handling,
        send: Callable[[Answer], None],
        listener: MemoryListener,
    ) -> None:
        self.service = service
        self.request_id = request_id
        self.robot = robot
        self.remaining_s = remaining_s
        self.payload = payload
        self.handling = handling
        self._send: Callable[[Answer], None] | None = send
        self._listener = listener

    def reply(self, payload: bytes, *, load: Load | None = None, more: bool = False) -> None:
        """Send the serialised response."""
        self.answer(Answer(self.request_id, payload=payload, load=load), "replies")

    def refuse(self, reason: Refusal, detail: str = "", *, load: Load | None = None) -> None:
        """Send a refusal."""
        if self._send is not None:
            self._listener.refused[reason.value] += 1
        answer = Answer(self.request_id, refusal=reason, detail=detail, load=load)
        self.answer(answer, "refused")

    def __del__(self) -> None:
        """Refuse what its owner forgot."""
        self.refuse(Refusal.LOST)

    def answer(self, answer: Answer, event: str) -> None:
        """Send the first answer; later ones do nothing."""
        send, self._send = self._send, None
        if send is not None:
            self._listener.count[event] += 1
            send(answer)
