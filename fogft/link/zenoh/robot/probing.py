"""The probes of a link: the replica's answers, and for how long it has been silent.

Two silences are measured: the replica's over all connections, which is shown to users, and the
current connection's, which decides when to give it up. `link` decides when to probe.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from fogft.errors import FrameError, WireError
from fogft.link import probe_frames
from fogft.link.port import Peer, Probe, ProbeAnswer
from fogft.model import names
from fogft.model.replica import doubted_after_s

if TYPE_CHECKING:
    from fogft.link.zenoh.robot.connection import Connection


class Silence:
    """For how long a replica has not answered probes. Times are monotonic seconds."""

    def __init__(self) -> None:
        self.since: float | None = None  # None while probes are answered

    def began(self, now: float) -> None:
        """Note that a probe was sent or cannot be sent. Continuing silence is not restarted."""
        if self.since is None:
            self.since = now

    def ended(self) -> None:
        """Note an answer."""
        self.since = None

    def excuse(self, held_up_s: float, now: float) -> None:
        """Exclude `held_up_s` before `now`, in which this process did not run."""
        if self.since is not None and held_up_s > 0:
            self.since = min(self.since + held_up_s, now)

    def for_s(self, now: float) -> float:
        """Return for how long it has lasted; 0 while probes are answered."""
        return 0.0 if self.since is None else max(0.0, now - self.since)


# The connection of an answer, its bytes, when its probe was sent, and when the answer came.
Heard = tuple["Connection", bytes, float, float]


class Probing:
    """Probes to one replica. For the link's thread; any thread may read the attributes.

    `came` is called, on any thread, when an answer has come.
    """

    def __init__(self, peer: Peer, came: Callable[[], None]) -> None:
        self._peer = peer
        self._came = came
        self._key = names.slot_key(peer.id.pool_uid, peer.id.slot, names.PROBE)
        self._queue: deque[Heard] = deque()  # filled by Zenoh's thread
        self._of_replica = Silence()
        self.silent_s = self._of_replica.for_s  # how long the replica has been silent
        self.nobody_to_ask = self._of_replica.began  # it is unreachable: silent from now on
        self._of_connection = Silence()
        self.unheard_s = self._of_connection.for_s
        self.another_connection = self._of_connection.ended  # from now on probes use another one
        self._doubted = False
        self._content = b""  # of the last answer: an idle replica repeats the same one
        self.answer: ProbeAnswer | None = None  # the last one
        self.heard_at: float | None = None  # when it came, monotonic seconds
        self.rtt_s: float | None = None  # its round-trip time

    def ask(self, connection: Connection, probe: Probe, now: float) -> None:
        """Send a probe. Raises zenoh.ZError: it could not be sent."""
        self._of_connection.began(now)
        self._of_replica.began(now)

        def heard(content: bytes) -> None:
            self._queue.append((connection, content, now, time.monotonic()))
            self._came()

        connection.probe(self._key, probe_frames.encode_probe(probe), heard)

    def heard(self, connection: Connection) -> Iterator[Heard]:
        """Return the answers of this connection since the last call; others are dropped."""
        while self._queue:
            heard = self._queue.popleft()
            if heard[0] is connection:
                yield heard

    def take(self, heard: Heard) -> ProbeAnswer:
        """Take an answer, which ends the silence. Raises WireError: it is not the peer's."""
        _, content, sent_at, at = heard
        answer = self._read(content)
        self._of_connection.ended()
        self._of_replica.ended()
        self.heard_at = at
        self.rtt_s = at - sent_at
        self.answer = answer
        return answer

    def _read(self, content: bytes) -> ProbeAnswer:
        id, at = self._peer.id, self._peer.endpoint
        if content == self._content and self.answer is not None:
            return self.answer
        try:
            answer = probe_frames.decode_probe_answer(content)
        except FrameError as error:
            raise WireError(f"`{at}` answers probes with {error}") from error
        if (answer.slot, answer.generation) != (id.slot, id.generation):
            raise WireError(
                f"`{at}` identifies itself as {answer.slot}.{answer.generation}, not {id.short}"
            )
        self._content, known = content, self.answer
        if not answer.types and known is not None and known.incarnation == answer.incarnation:
            return replace(answer, types=known.types)
        return answer

    def excuse(self, seconds: float, now: float) -> None:
        """Exclude time before `now` in which nothing could be received."""
        for silence in (self._of_replica, self._of_connection):
            silence.excuse(seconds, now)

    def late(self, now: float) -> tuple[bool, float]:
        """Return whether an answer is late (true once per silence), and the time left until then.

        The time is infinite once it is late, and while none is awaited.
        """
        if self._of_replica.since is None:
            self._doubted = False
            return False, float("inf")
        left_s = doubted_after_s(self.rtt_s) - self.silent_s(now)
        was, self._doubted = self._doubted, left_s <= 0
        return self._doubted and not was, left_s if left_s > 0 else float("inf")
