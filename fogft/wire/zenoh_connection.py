"""One Zenoh session of a robot towards one replica, used once and thrown away.

A request is published at its service's key; the answers to all of them come as the replies to
one query, which stays open for as long as the connection. A query for each request would cost
a third more (its state, two timers and its end, at both ends), and its time-out at the replica
would be sent by the one thread that all else there needs, too.

Everything of Zenoh's that can block (`put`, `close`) is called by the connection's own
sender thread, so a peer that takes nothing costs nobody else. Callbacks come from Zenoh's
threads.

Owns: a session, its sender thread, the attempts open on it.
Not here: when to open and when to give up (`zenoh_link`).
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import zenoh
from zenoh import handlers

from fogft.core import names
from fogft.core.errors import WireError
from fogft.core.records import Sign
from fogft.wire import batch_frames, frame
from fogft.wire.compression import Compression
from fogft.wire.credit import Credit
from fogft.wire.diagnosis import wrong_name
from fogft.wire.flow_watch import FlowWatch
from fogft.wire.held import Held
from fogft.wire.in_time import InTime
from fogft.wire.leaving import see_off
from fogft.wire.link_window import ATTEMPTS_LIMIT, LinkWindow
from fogft.wire.port import Answer, Peer, Refusal
from fogft.wire.recalls import Recalls
from fogft.wire.send_queue import SendQueue
from fogft.wire.sockets import address
from fogft.wire.turns import LARGE_BYTES, Turns
from fogft.wire.unanswered import Unanswered
from fogft.wire.ways import PLAIN_WAYS, Ways
from fogft.wire.zenoh_attempt import OpenAttempt, read_reply

log = logging.getLogger(__name__)

_ALL = zenoh.QueryTarget.ALL
# NONE, not the default: under AUTO (and LATEST) Zenoh holds the replies back until the
# last replica has answered. Kept true by tests/wire/test_first_reply_is_not_held_back.
_AT_ONCE = zenoh.ConsolidationMode.NONE
# Attempts that wait for the sender, forgotten ones included: those have freed their room in the
# window, so without a bound of its own the queue of a sender that is stuck would grow.
_QUEUE_LIMIT = 2 * ATTEMPTS_LIMIT
# A `put` that took this long was stuck behind a full queue: see whether the session survived.
_STUCK_S = 0.1
# What Zenoh itself may hold of a large request once its sending has returned: two batches.
_ZENOH_HOLDS_BYTES = 2 * 65535
# How long the keeper looks often after the last large request began to leave.
_WATCH_S = 5.0
# How long a closed connection may still flow.
_END_WITHIN_S = 1.0
# For as long as the connection: Zenoh ends the query when the session closes.
_ANSWERS_TIMEOUT_S = 1e9


_REFUSED = {
    Refusal.REVOKED: "our certificate is revoked",
    Refusal.NOT_ADMITTED: "the replica does not let us in: our certificate is not good for asking",
    Refusal.EXPIRED_CERTIFICATE: "our certificate is not valid now, by the replica's clock",
}


_TELL_RECORDS_TIMEOUT_S = 5.0


# In the queue, in place of an attempt: tell the replica of what was forgotten.
_TELL = OpenAttempt("", b"", b"", offered=0.0, remaining_s=0.0)


class Connection:
    """An open session whose peer was found to be the right one.

    Args:
        config: Zenoh's configuration of the session.
        peer: Whom it must reach.
        robot: Who we are.
        keys: Service name -> key.
        sign: Signs our greeting.
        ways: How the services' payloads are sent.
        turns: Shared with the robot's other connections.
        recalls: Of whom the replica is told that it may stop; None to tell of nobody.
        answered: Called with each attempt's end, once. Must not block.
        late: Called with service and id when a forgotten request was answered. Must not block.
        lost: Called, from any thread and perhaps more than once, when it is no longer of use.
        room: Called when a window that was full has room again.
        large: Called when something large is sent and `watched` is not set. Must not block.

    Raises:
        zenoh.ZError: Nothing was reached.
        WireError: Somebody else was reached. Nothing was sent to them.
        CredentialError: Our own certificate or key cannot be used.
    """

    def __init__(
        self,
        config: zenoh.Config,
        peer: Peer,
        robot: str,
        keys: Mapping[str, str],
        *,
        sign: Sign,
        ways: Ways = PLAIN_WAYS,
        turns: Turns,
        recalls: Recalls | None = None,
        answered: Callable[[Answer], None],
        late: Callable[[str, bytes], None],
        lost: Callable[[], None],
        room: Callable[[], None],
        large: Callable[[], None] = lambda: None,
    ) -> None:
        self._turns = turns
        self._on_large = large
        self._large_since = float("-inf")
        self._sending_since: float | None = None
        self._held_by_zenoh = (0.0, 0)  # since when, so many bytes at most
        self.watched = False
        self._answered = answered
        self._late = late
        self._on_lost = lost
        self._room = room
        self._begun = False
        self._unanswered = Unanswered()
        self._held = Held()
        self._token = secrets.token_bytes(frame.TOKEN_BYTES)
        self._origin = frame.origin(robot, self._token)
        self.certificate, signature = sign(frame.greeted_bytes(self._token, peer.certificate_name))
        greeting = frame.Greeting(self._token, self.certificate, signature)
        self._greeting = frame.encode_greeting(greeting)
        self._queue = SendQueue(ways.latest)
        self._compressions = {name: Compression() for name in keys.keys() - ways.plain}
        self.packs = False  # whether the replica reads what is compressed
        self.packs_answers = False  # whether it finds out by itself when to compress answers
        self._credit = Credit()
        self._cancel_key = zenoh.KeyExpr(names.cancel_key(peer.id.pool_uid, peer.id.slot))
        self._answers_key = names.answers_key(peer.id.pool_uid, peer.id.slot)
        self._recalls = recalls
        self._telling = False
        self.window: LinkWindow[OpenAttempt] = LinkWindow()
        self.lost_because = ""
        self.told = b""  # the records that the replica has taken from us
        self._session = zenoh.open(config)
        try:
            self._listener = self._session.info.declare_link_events_listener(
                handlers.Callback(self._link_event, indirect=False)
            )
            self.flow = self._check_peer(peer)
            self._publishers = {
                name: self._session.declare_publisher(
                    key, congestion_control=zenoh.CongestionControl.BLOCK
                )
                for name, key in keys.items()
            }
        except BaseException:
            _close_aside(self._session, peer)
            raise
        self._in_time = InTime(
            ways.timed, self.flow.carries_bytes_per_s, self._left_bytes, self._compression
        )
        self._thread = threading.Thread(
            target=self._run, name=f"fogft-send-{peer.id.short}", daemon=True
        )
        self._thread.start()

    def _check_peer(self, peer: Peer) -> FlowWatch:
        links = self._session.info.links()
        found = {link.auth_identifier for link in links}
        if not found:
            raise WireError(f"`{peer.endpoint}` was lost as soon as it was reached")
        for name in found - {peer.certificate_name}:
            raise WireError(wrong_name(name, peer), "another machine has this address now")
        return FlowWatch(address(links[0].src), address(links[0].dst))

    def begin(self) -> bool:
        """Ask for the answers to come, once the replica has let us in; return whether it hears.

        What is published before Zenoh knows that it is heard there would be lost.

        Raises:
            zenoh.ZError: It could not be asked.
        """
        if self._begun:
            return True
        for publisher in self._publishers.values():
            if not publisher.matching_status.matching:  # type: ignore[attr-defined]
                return False
        self._session.get(
            self._answers_key,
            handlers.Callback(
                self._heard, lambda: self._lose("the replica ended our answers"), indirect=False
            ),
            attachment=frame.encode_greeting(frame.Greeting(self._token)),
            timeout=_ANSWERS_TIMEOUT_S,
            target=_ALL,
            consolidation=_AT_ONCE,
        )
        self._begun = True
        return True

    # -- requests (any thread) ------------------------------------------------------------

    def offer(
        self,
        service: str,
        request_id: bytes,
        payload: bytes,
        remaining_s: float,
        *,
        more: bool = False,
    ) -> bool:
        """Take an attempt, or return False. Never blocks. With `more`, `send` must follow."""
        if service not in self._publishers or self._queue.qsize() >= _QUEUE_LIMIT:
            return False
        now = time.monotonic()
        attempt = OpenAttempt(service, request_id, payload, offered=now, remaining_s=remaining_s)
        if not self._in_time.may_arrive(attempt, remaining_s, now, partial(self._before, service)):
            return False
        if not self.window.admit(attempt) and not self._displace(attempt):
            return False
        mark = self._credit.take(attempt.size)
        if mark is None:
            self.send()
            attempt.mark = self._credit.queue(attempt.size)
            self._queue.put(attempt)
            return True
        # It cannot block: the hop to another thread is saved.
        attempt.mark = mark
        if (more or self._held) and attempt.size <= batch_frames.ENTRY_BYTES_LIMIT:
            self._send_together(self._held.add(attempt))
        else:
            self._send_or_lose(attempt)
        if not more:
            self.send()
        return True

    def send(self) -> None:
        """Send what was offered with `more`. Never blocks: it was small, and reserved."""
        self._send_together(self._held.take())

    def _send_together(self, attempts: Sequence[OpenAttempt]) -> None:
        if len(attempts) < 2 or self.flow.thin:  # there, each is compressed
            for attempt in attempts:
                self._send_or_lose(attempt)
            return
        now = time.monotonic()
        parts = []
        for attempt in attempts:
            payload = attempt.payload  # read once, as in `_send`
            attempt.payload = None
            if payload is not None and self.window.holds(attempt):
                parts.append((attempt.request_id, max(attempt.deadline - now, 0.0), payload))
                self._unanswered.add(attempt)
        if not parts:
            return
        header, content = batch_frames.encode_requests(parts, self._origin)
        try:
            self._publishers[attempts[0].service].put(content, attachment=header)
        except Exception as error:  # whatever it is, the attempts must end
            self._lose(f"sending failed: {error}")
            for attempt in attempts:
                self._end(attempt, None, Refusal.LOST)

    def _before(self, service: str) -> list[OpenAttempt]:
        """Return what leaves before an attempt that comes now."""
        if self._queue.overtakes(service):
            return []
        return [one for one in self.window.attempts() if one.payload is not None]

    def _left_bytes(self, now: float, bytes_per_s: float) -> float:
        """Return what was sent and has not arrived: in the kernel, and in Zenoh above it."""
        since, held = self._held_by_zenoh
        left = max(0.0, held - bytes_per_s * (now - since))
        return left + self.flow.left_bytes(now, bytes_per_s)

    def _compression(self, service: str) -> Compression | None:
        return self._compressions.get(service) if self.packs else None

    def _displace(self, attempt: OpenAttempt) -> bool:
        """Let a newer attempt in for the stalest unsent one, where its service wants that."""
        stale = self._queue.stalest(attempt)
        if stale is None:
            return False
        self._end(stale, None, Refusal.SUPERSEDED)
        return self.window.admit(attempt)

    def forget(self, request_id: bytes) -> None:
        """Free the room and the bytes of a request, also where its sender is stuck."""
        attempt = self.window.forget(request_id)
        if attempt is None:
            return
        sent, recalls, now = attempt.payload is None, self._recalls, time.monotonic()
        if sent and recalls is not None and recalls.add(request_id, attempt.offered, now):
            self.flush()
        attempt.payload = None
        if self.window.regained_room():
            self._room()

    def flush(self) -> None:
        """Have the replica told of what was forgotten and not answered."""
        if self._recalls and not self._telling:  # there are some
            self._telling = True
            self._queue.put(_TELL)

    def _end(self, attempt: OpenAttempt, payload: bytes | None, refusal: str = "") -> None:
        if self.window.remove(attempt):
            attempt.payload = None
            self._answered(Answer(attempt.request_id, payload, refusal, attempt.service))
            if self.window.regained_room():
                self._room()

    # -- the sender thread ----------------------------------------------------------------

    def _run(self) -> None:
        while True:
            attempt = self._queue.get()
            if attempt is None:
                break
            if attempt is _TELL:
                self._tell()
                continue
            self._send_or_lose(attempt)
            self._credit.dequeued()
        _close(self._session)

    def _tell(self) -> None:
        self._telling = False
        ids = self._recalls.take() if self._recalls is not None else []
        if not ids:
            return
        try:
            self._session.put(
                self._cancel_key,
                frame.encode_cancel(ids),
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
        except zenoh.ZError as error:
            self._lose(f"sending failed: {error}")

    def _send_or_lose(self, attempt: OpenAttempt) -> None:
        try:
            self._send(attempt)
        except Exception as error:  # whatever it is, the attempt must end
            self._lose(f"sending failed: {error}")
            self._end(attempt, None, Refusal.LOST)

    def _send(self, attempt: OpenAttempt) -> None:
        payload = attempt.payload  # read once: `forget` may take it away at any moment
        if payload is None or not self.window.holds(attempt):
            return  # forgotten while it waited
        remaining_s = attempt.deadline - time.monotonic()
        if remaining_s <= 0:
            self._end(attempt, None, Refusal.LOST)
            return
        if not self._in_time.may_arrive(attempt, remaining_s, time.monotonic()):
            self._end(attempt, None, Refusal.TOO_SLOW)
            return
        attempt.payload = None
        large = attempt.size >= LARGE_BYTES
        turn = self._turns.take() if large else None
        began = time.monotonic()
        if large:
            self._large_since = self._sending_since = began
            self._sends_large()
        try:
            if self.window.holds(attempt):  # else `close` has ended it, and may not see this send
                self._publish(attempt, payload, remaining_s)
        finally:
            self._sending_since = None
            self._turns.give(turn)
        if large:
            self._held_by_zenoh = time.monotonic(), min(attempt.size, _ZENOH_HOLDS_BYTES)
        if time.monotonic() - began > _STUCK_S and not self.alive():
            self._lose("it took nothing more, and Zenoh gave the session up")

    def _sends_large(self) -> None:
        """Have the keeper look whether it flows, from now on and for a while."""
        if not self.watched:
            self.watched = True
            self._on_large()

    def _publish(self, attempt: OpenAttempt, payload: bytes, remaining_s: float) -> None:
        compression = self._compression(attempt.service)
        packed = None
        if compression is not None:
            packed = compression.pack(payload, self.flow.bytes_per_s)
        self._unanswered.add(attempt)
        self._publishers[attempt.service].put(
            payload if packed is None else packed,
            attachment=frame.encode_request(
                attempt.request_id,
                remaining_s,
                self._origin,
                packed=packed is not None,
                may_pack=self.flow.thin and compression is not None,
                reads_packed=self.packs_answers and compression is not None,
            ),
        )

    # -- Zenoh's threads ------------------------------------------------------------------

    def _heard(self, reply: zenoh.Reply) -> None:
        try:
            answers = read_reply(reply)
        except frame.FrameError as error:
            self._lose(f"its answers cannot be read: {error}")
            return
        for answer in answers:
            self._take_answer(answer)

    def _take_answer(self, answer: Answer) -> None:
        attempt = self._unanswered.answered(answer.request_id)
        if attempt is None:
            return  # it was answered before
        if answer.payload is not None:
            self._credit.heard(attempt.mark)  # requests of one connection arrive in order
        if self.window.holds(attempt):
            self._end(attempt, answer.payload, answer.refusal)
            return
        if self._recalls is not None:  # it was forgotten, or has ended
            self._recalls.answered(answer.request_id)
        if answer.payload is not None or answer.refusal == Refusal.LATE:
            self._late(attempt.service, answer.request_id)

    def _link_event(self, event: zenoh.LinkEvent) -> None:
        if event.kind == zenoh.SampleKind.DELETE:
            self._lose("the connection was lost")

    def _lose(self, because: str) -> None:
        self.lost_because = self.lost_because or because
        self._on_lost()

    # -- the keeper -----------------------------------------------------------------------

    def look(self, now: float) -> float:
        """Look what flows; return for how many of the last seconds something large moved."""
        if self.watched and now - self._large_since > _WATCH_S and not self._queue.qsize():
            self.watched = False
        since = self._sending_since
        return self.flow.look(now, 0.0 if since is None else now - since)

    def alive(self) -> bool:
        """Whether Zenoh still has a link beneath this session."""
        try:
            return bool(self._session.info.links())
        except zenoh.ZError:
            return False

    def probe(
        self, key: str, payload: bytes, timeout_s: float, heard: Callable[[bytes], None]
    ) -> None:
        """Send a probe ahead of all requests; `heard` gets the answer's bytes, if one comes.

        Raises:
            zenoh.ZError: It could not be sent.
        """

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._greeting = bare  # we are known from now on
                heard(reply.ok.payload.to_bytes())
            elif reply.err is not None:
                self._probe_refused(reply.err.payload.to_bytes())

        bare = frame.encode_greeting(frame.Greeting(self._token))

        self._session.get(
            key,
            handlers.Callback(on_reply, indirect=False),
            payload=payload,
            attachment=self._greeting,
            timeout=timeout_s,
            # The keeper must not wait behind what is stuck: a lost probe is an unanswered one.
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            express=True,
            target=_ALL,
            consolidation=_AT_ONCE,
        )

    def _probe_refused(self, content: bytes) -> None:
        try:
            _, reason = frame.decode_refusal(content)
        except frame.FrameError:
            return  # Zenoh's own: it timed out, and the keeper counts the silence
        words = _REFUSED.get(reason, f"the replica refuses our probes: {reason}")
        self._lose(words)

    def tell_records(self, key: str, records: bytes) -> None:
        """Send signed records; `told` is them once the replica has taken them.

        Raises:
            zenoh.ZError: They could not be sent.
        """

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self.told = records

        self._session.get(
            key,
            handlers.Callback(on_reply, indirect=False),
            payload=records,
            attachment=frame.encode_greeting(frame.Greeting(self._token)),
            timeout=_TELL_RECORDS_TIMEOUT_S,
            congestion_control=zenoh.CongestionControl.DROP,
            # Not that of the answers: its end at the replica must not wait for room among them.
            priority=zenoh.Priority.DATA_LOW,
            target=_ALL,
            consolidation=_AT_ONCE,
        )

    def sweep(self) -> None:
        """End the attempts whose time is up and of which Zenoh told nothing."""
        now = time.monotonic()
        for attempt in self.window.attempts():
            if attempt.deadline <= now:
                self._end(attempt, None, Refusal.LOST)

    def close(self) -> None:
        """End it: what is open is lost. Returns at once; the sender thread closes the session."""
        ended = self.window.close()
        see_off(self._thread)
        # A large send that goes on is for nobody any more, and may block for minutes.
        threading.Thread(target=self._end_flow, name="fogft-end-link", daemon=True).start()
        for attempt in ended:
            attempt.payload = None
            self._answered(Answer(attempt.request_id, None, Refusal.LOST, attempt.service))

    def _end_flow(self) -> None:
        try:
            self.flow.end_when_safe(
                lambda: self._sending_since is not None,
                lambda: len(self._unanswered) > 0,
                _END_WITHIN_S,
            )
        finally:
            self._queue.put(None)

    def join(self, timeout_s: float) -> None:
        """Wait for the sender thread, which ends within 11 s even where the peer is frozen."""
        self._thread.join(timeout_s)


def _close(session: Any) -> None:
    try:
        session.close()
    except zenoh.ZError as error:  # the peer is frozen with data in flight; Zenoh waits 10 s
        log.debug("session_closed_late reason=%r", str(error))


def _close_aside(session: Any, peer: Peer) -> None:
    closer = threading.Thread(
        target=_close, args=(session,), name=f"fogft-close-{peer.id.short}", daemon=True
    )
    closer.start()
    see_off(closer)
