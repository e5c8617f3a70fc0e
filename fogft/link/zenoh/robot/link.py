"""Links over Zenoh: connect to a replica, probe it, and reconnect when it falls silent.

Each link has a thread (`fogft-keep-...`) that replaces the connection if it is lost or if probes go
unanswered, but never because a service is slow.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import zenoh

from fogft import __version__
from fogft.errors import CredentialError, WireError
from fogft.link.port import Answer, LinkEvents, LinkStatus, Peer, Probe, ProbeAnswer
from fogft.link.zenoh import settings
from fogft.link.zenoh.diagnosis import Opening
from fogft.link.zenoh.robot.attempts import Callbacks
from fogft.link.zenoh.robot.connection import Connection, Shared
from fogft.link.zenoh.robot.probing import Probing
from fogft.link.zenoh.threads import join_at_exit
from fogft.model import names
from fogft.model.replica import LinkState
from fogft.process import on_thread
from fogft.requests.load import NEVER

log = logging.getLogger(__name__)

_PROBE_EVERY_S = 1.0
_FIRST_PROBES_EVERY_S = 0.1
_UNREADY_PROBES_EVERY_S = 0.25  # a reachable replica gets requests soon after it is ready
_BACKOFF_S = (0.1, 0.2, 0.4, 0.5)
_RENEW_AGAIN_S = 5.0
_TELL_AGAIN_S = 10.0
_LOOK_EVERY_S = 0.1  # while a large message is sent
_LOOK_AGAIN_S = 0.05  # the shortest interval


@dataclass(eq=False)
class ZenohLink:
    """A link to one replica; see `port.Link`. Created by `ZenohDialer`."""

    shared: Shared
    peer: Peer
    services: Mapping[str, str]
    events: LinkEvents
    on_close: Callable[[ZenohLink], None]

    def __post_init__(self) -> None:
        shared, peer = self.shared, self.peer
        self._suspect_after_s = shared.suspect_after_s
        self._probe_every_s = min(_PROBE_EVERY_S, shared.suspect_after_s / 2)
        self._config = settings.robot_settings(peer, shared.credentials, shared.settings)
        self._wake = threading.Event()
        self._woke_at = 0.0
        self._closed = False
        self._probing = Probing(peer, self._wake.set)
        self._tell = Callbacks(
            answered=self._answered,
            late=self._late,
            room=self._changed,
            wake=self._wake.set,
        )
        # Written by the link's thread only; `_live` is set exactly while the state is UP.
        self._live: Connection | None = None
        self.offer: Callable[..., bool] = _decline  # that of the live connection, if any
        self._state = LinkState.CONNECTING
        self.ready: frozenset[str] = frozenset()
        self._detail = "not reached yet"
        self._opening = Opening(peer, shared.settings)
        self._opened = 0
        self._ignores = False
        self._looked_at = 0.0
        self._renew_at = NEVER
        self._retiring: list[Connection] = []  # replaced, with requests in flight
        self.thread: threading.Thread | None = None
        self.flush()

    # -- port.Link ------------------------------------------------------------------------

    @property
    def usable(self) -> bool:
        """Whether requests may be offered."""
        return self._live is not None

    @property
    def sending(self) -> bool:
        """Whether an attempt is being sent right now."""
        live = self._live
        return live is not None and live.attempts.sending

    @property
    def thin(self) -> bool:
        """Whether its network path was measured to be slow."""
        live = self._live
        return live is not None and live.flow.thin

    @property
    def leaving(self) -> bool:
        """Whether the replica is leaving."""
        answer = self._probing.answer
        return answer is not None and answer.draining

    @property
    def certificate(self) -> bytes:
        """The certificate (DER) that its open connection uses; empty unless UP."""
        live = self._live
        return b"" if live is None else live.certificate

    def send(self) -> None:
        """Flush requests that were offered with `more`. Never blocks."""
        for connection in (self._live, *self._retiring):  # one may have just been live
            if connection is not None:
                connection.attempts.send()

    def forget(self, request_id: bytes) -> None:
        """Free the window of a request whose answer is no longer wanted."""
        for connection in (self._live, *self._retiring):
            if connection is not None:
                connection.attempts.forget(request_id)

    def flush(self) -> None:
        """Send requests offered with `more`, and cancellations of forgotten, unanswered ones."""
        for connection in (self._live, *self._retiring):
            if connection is not None:
                connection.attempts.send()
                connection.attempts.flush()
        if self.thread is None:
            try:
                self.thread = on_thread(self._keep, name=f"fogft-keep-{self.peer.id.short}")
            except OSError as error:  # tried again at the next call
                self._say(str(error))

    def status(self) -> LinkStatus:
        """Return a snapshot."""
        now = time.monotonic()
        live, heard_at = self._live, self._probing.heard_at
        return LinkStatus(
            state=self._state,
            probe_answer=self._probing.answer,
            heard_age_s=None if heard_at is None else now - heard_at,
            silent_for_s=self._probing.silent_s(now),
            rtt_s=self._probing.rtt_s,
            in_flight=len(live.attempts.window) if live else 0,
            reopened=max(self._opened - 1, 0),
            detail=self._detail,
            ignores=self._ignores,
        )

    def close(self) -> None:
        """Close the link; its thread frees the rest shortly afterwards."""
        self._closed = True
        if self.thread is not None:
            join_at_exit(self.thread)
        self._wake.set()
        live = self._live
        self._nothing_live()
        if live is not None:
            live.close()
        self.on_close(self)

    def renew(self) -> None:
        """Switch to new credentials over a new connection; returns at once, no request is lost."""
        self._renew_at = 0.0
        self._wake.set()

    # -- the link's thread ----------------------------------------------------------------

    def _keep(self) -> None:
        failures = 0
        while not self._closed:
            self._probing.nobody_to_ask(time.monotonic())
            failures = 0 if self._hold() else failures + 1
            self._woke_at = time.monotonic()  # the time spent on opening counts as silence
            self._let_go()
            if not self._closed:
                self._pause(_BACKOFF_S[min(failures, len(_BACKOFF_S) - 1)])
        self._let_go()

    def _hold(self) -> bool:
        """Open a connection and maintain it until it is lost; return whether it was up."""
        was_up = False
        connection = None
        try:
            connection = self._open()
            while connection is not None:
                was_up = self._attend(connection) or was_up
                if connection is not self._live or self._closed or connection.lost_because:
                    break
                connection = self._succeed(connection)  # replaced by one with new credentials
        except Exception as error:  # a bug must not end the link for good
            log.exception("link_failed replica=%s", self.peer.id.short)
            if connection is not None:
                connection.lost_because = f"{type(error).__name__}: {error}"
        if connection is not None:
            self._part(connection)
        return was_up

    def _succeed(self, old: Connection) -> Connection:
        """Open a new connection while the old one is up; return it once it is up, else the old."""
        self._renew_at = NEVER
        new = self._open()
        if new is not None and self._attend(new, until_up=True) and new is self._live:
            log.info("link_renewed replica=%s", self.peer.id.short)
            return new
        if new is not None:
            self._say(new.lost_because)
            new.close()
        self._renew_at = min(self._renew_at, time.monotonic() + _RENEW_AGAIN_S)
        self._probing.another_connection()
        return old

    def _let_go(self) -> None:
        """Close replaced connections once they have no requests in flight."""
        for connection in list(self._retiring):
            connection.attempts.sweep()
            if not len(connection.attempts.window) or connection.lost_because or self._closed:
                self._retiring.remove(connection)
                connection.close()

    def _open(self) -> Connection | None:
        began = time.monotonic()
        open_timeout_ms = round(self._opening.timeout_s * 1e3)
        config = self._config | {"transport/unicast/open_timeout": open_timeout_ms}
        try:
            connection = Connection(
                settings.to_zenoh(config), self.peer, self.services, self.shared, self._tell
            )
        except (WireError, CredentialError) as error:
            self._say(error.message)
            return None
        except zenoh.ZError as error:
            if not self._closed:
                now = time.monotonic()
                why = self._opening.failed(now - began, now, self.shared.credentials)
                self._say(why or self._detail or str(error))
            return None
        self._opened += 1
        self._opening.done()
        return connection

    def _attend(self, connection: Connection, *, until_up: bool = False) -> bool:
        """Probe a connection until it must go, or is up (`until_up`); return whether it was up."""
        up = False
        self._woke_at = next_probe = time.monotonic()
        self._probing.another_connection()
        while not self._closed and not connection.lost_because and not (up and until_up):
            now = time.monotonic()
            if now >= self._renew_at and connection is self._live:
                break
            self._let_go()
            if not self._flows(connection, now):
                break
            try:
                if now >= next_probe:
                    said = self._probing.answer  # a hanging service is restarted anyway
                    hangs = said is not None and bool(said.hanging)
                    self._ignores |= connection.attempts.sweep() and not hangs
                    self._probe(connection, now)
                    if up:
                        self._tell_records(connection)
                    next_probe = now + self._next_probe_in_s(up=up)
                left_s = self._suspect_after_s - self._probing.unheard_s(now)
                if left_s <= 0:
                    connection.lost_because = f"no probe answered for {self._suspect_after_s:g} s"
                    break
                often = _LOOK_EVERY_S if connection.attempts.watched else left_s
                self._pause(min(next_probe - now, left_s, often, self._doubt(now)))
                up = self._listen(connection) or up
            except WireError as error:
                connection.lost_because = error.message
            except zenoh.ZError as error:
                connection.lost_because = f"sending failed: {error}"
        return up

    def _flows(self, connection: Connection, now: float) -> bool:
        """Check that large sends progress, which excuses silence; False if they are stuck."""
        if now - self._looked_at < _LOOK_AGAIN_S:
            return not connection.lost_because
        self._looked_at = now
        moved_s = connection.flow.look(now, connection.attempts.look(now))
        self._probing.excuse(moved_s, now)
        longest_s, shortest_s = self._suspect_after_s, self.shared.settings.stall_after_s
        if connection.flow.progress.stalled(now, shortest_s=shortest_s, longest_s=longest_s):
            connection.lost_because = "it no longer reads what is sent"
        return not connection.lost_because

    def _doubt(self, now: float) -> float:
        """Notify the owner once if a probe's answer is late; return seconds to the next check."""
        late, left_s = self._probing.late(now)
        if late and self._live is not None:
            silent_s = self._probing.silent_s(now)
            log.info("link_doubted replica=%s silent_s=%.2f", self.peer.id.short, silent_s)
            self._changed()
        return left_s

    def _next_probe_in_s(self, *, up: bool) -> float:
        if not up:
            return _FIRST_PROBES_EVERY_S
        if self.services.keys() <= self.ready:
            return self._probe_every_s
        return min(self._probe_every_s, _UNREADY_PROBES_EVERY_S)

    def _tell_records(self, connection: Connection) -> None:
        """Send records that the replica lacks, and all periodically, as it may have newer ones."""
        records, id = self.shared.records, self.peer.id
        again = bool(records) and time.monotonic() - connection.told_at > _TELL_AGAIN_S
        if again or records != connection.told:
            newer = partial(self.shared.newer.__setitem__, id.slot)
            key = names.slot_key(id.pool_uid, id.slot, names.RECORDS)
            connection.tell_records(key, records, newer)

    def _probe(self, connection: Connection, now: float) -> None:
        known = self._probing.answer
        # Its types are requested once per connection: each may be to another process.
        describe = self._live is not connection or known is None or not known.types
        self._probing.ask(connection, Probe(self.shared.robot, describe, __version__), now)
        if not connection.alive():
            connection.lost_because = "the connection was lost"

    def _listen(self, connection: Connection) -> bool:
        """Take answers to probes; return whether they bring the link up. Raises WireError."""
        up = False
        for heard in self._probing.heard(connection):
            if connection.begin():
                known = self._probing.answer
                self._answers(connection, known, self._probing.take(heard))
                up = True
        return up

    def _answers(
        self, connection: Connection, known: ProbeAnswer | None, answer: ProbeAnswer
    ) -> None:
        """Take an answer to a probe: its connection is the live one from now on."""
        news = self._live is not connection or answer != known
        attempts, rtt_s = connection.attempts, self._probing.rtt_s or 0.0
        attempts.round_trip_s = min(attempts.round_trip_s or rtt_s, rtt_s)
        self.ready = answer.ready
        old = self._live
        if old is not connection:
            if old is not None:  # first: its requests must still be sent, or forgotten
                self._retiring.append(old)
            self._state = LinkState.UP
            self._detail = ""
            self.offer, self._live = connection.attempts.offer, connection
            log.info("link_up replica=%s rtt_s=%.4f", self.peer.id.short, self._probing.rtt_s)
        if self._closed:  # by another thread, just now
            self._nothing_live()
        elif news:
            self._changed()

    def _nothing_live(self) -> None:
        self._live, self.offer, self.ready = None, _decline, frozenset()

    def _part(self, connection: Connection) -> None:
        """Drop a connection: nothing more is offered to it, and its open attempts are lost."""
        was_up = self._live is not None
        self._nothing_live()
        self._renew_at = NEVER  # the next one uses the current credentials anyway
        if was_up:
            self._state = LinkState.SUSPECT
            log.warning("link_lost replica=%s reason=%r", self.peer.id.short,
                        connection.lost_because)  # fmt: skip
        if not self._closed:
            self._probing.nobody_to_ask(time.monotonic())
            self._say(connection.lost_because)
        connection.close()
        if was_up:
            self._changed()

    def _pause(self, wanted_s: float) -> None:
        """Wait for `wanted_s` or until woken. Time when this process did not run is not silence."""
        wanted_s = max(wanted_s, 0.0)
        self._wake.wait(wanted_s)
        self._wake.clear()
        now = time.monotonic()
        self._probing.excuse(now - self._woke_at - wanted_s, now)
        self._woke_at = now

    def _say(self, detail: str) -> None:
        if detail != self._detail:
            self._detail = detail
            log.info("link_detail replica=%s detail=%r", self.peer.id.short, detail)
            self._changed()

    # -- to the owner (any thread) --------------------------------------------------------

    def _answered(self, answer: Answer) -> None:
        try:
            self.events.answered(self, answer)
        except Exception:  # on Zenoh's thread nothing else would report it
            log.exception("answer_not_taken request=%s", answer.request_id.hex())

    def _late(self, answer: Answer) -> None:
        if not self._closed:
            self.events.late(self, answer)

    def _changed(self) -> None:
        try:
            self.events.changed(self)
        except Exception:
            log.exception("change_not_taken replica=%s", self.peer.id.short)


def _decline(*_: object, **__: object) -> bool:
    return False
