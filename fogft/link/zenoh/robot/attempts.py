"""The attempts open on one connection: accepted, sent and ended exactly once.

The offering thread sends a request itself if that cannot block (`credit`), else the connection's
own sender thread does, so a peer that reads nothing affects no other link. Not here: the session
(`connection`), the outcome of requests (`fogft.proxy.robot.dispatcher`).
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Protocol

from fogft.link import batch_frames, frame
from fogft.link.compression import ASIDE_BYTES, Compression, Unpacker
from fogft.link.credit import LARGE_BYTES, Credit, LargeSendGate
from fogft.link.port import Answer, SendOptions
from fogft.link.socket_progress import DeadlineFilter
from fogft.link.window import (
    ATTEMPTS_LIMIT,
    BatchBuffer,
    Cancellations,
    LinkWindow,
    OpenAttempt,
    SendQueue,
    Unanswered,
)
from fogft.link.zenoh.flow_watch import FlowWatch
from fogft.link.zenoh.threads import join_at_exit
from fogft.model import topic
from fogft.model.refusal import Refusal
from fogft.process import on_thread
from fogft.requests.load import Handling

# Attempts that wait for the sender, forgotten ones included: those have left the window, so
# without its own bound the queue of a stuck sender would grow.
_QUEUE_LIMIT = 2 * ATTEMPTS_LIMIT
# A `put` that took this long was stuck behind a full queue: check whether the session survived.
_STUCK_S = 0.1
# Bytes of a large request that Zenoh itself may still hold after `put` has returned: two batches.
_ZENOH_HOLDS_BYTES = 2 * 65535
# How long the link's thread checks often after it began to send the last large request.
_WATCH_S = 5.0

# In the queue, in place of an attempt: send the pending cancellations.
_TELL = OpenAttempt("", b"", None, 0, 0.0, 0.0)


class Outlet(Protocol):
    """The interface of a connection that attempts use."""

    flow: FlowWatch  # the kernel's counters of its socket

    def publish(self, service: str, content: bytes, header: bytes) -> None:
        """Send a message to a service. May block while the peer does not read."""

    def cancel(self, ids: Sequence[bytes]) -> None:
        """Send cancellations of these requests. May block likewise."""

    def alive(self) -> bool:
        """Whether the Zenoh session still has a link."""

    def lose(self, because: str) -> None:
        """Note that the connection is lost. Any thread; may be called repeatedly."""


@dataclass(frozen=True)
class Callbacks:
    """Callbacks from a connection to its link. Called from any thread; none may block."""

    answered: Callable[[Answer], None]
    late: Callable[[Answer], None]
    room: Callable[[], None]  # a window that was full has room again
    wake: Callable[[], None]  # `Attempts.watched` was set, or the connection was lost; may repeat


@dataclass(eq=False)
class Attempts:
    """The attempts of one connection.

    `origin` is part of the headers of all its requests. With `tell_losers`, the replica is told
    which ones are no longer wanted.
    """

    outlet: Outlet
    services: frozenset[str]
    origin: bytes
    _: KW_ONLY
    options: SendOptions
    gate: LargeSendGate
    tell_losers: bool
    tell: Callbacks
    ended: Callable[[], None]
    name: str

    def __post_init__(self) -> None:
        options, outlet = self.options, self.outlet
        self._cancellations = Cancellations()
        self.window = LinkWindow(standing=len(self.services))
        self.watched = False  # a large send was recent: the link's thread checks often
        self.round_trip_s = 0.0  # the shortest seen
        self._large_since = float("-inf")
        self._sending_since: float | None = None
        self._held_by_zenoh = (0.0, 0)  # since when, and how many bytes at most
        self._seen = frame.NO_STAMP  # the stamp of the last answer
        self._telling = False
        self._unanswered = Unanswered()
        self.awaited = self._unanswered.__len__  # how many answers may come, late ones included
        self._unpacker = Unpacker()
        self._batch = BatchBuffer()
        self._credit = Credit()
        self._queue = SendQueue(options.latest)
        self._compressions = {name: Compression() for name in self.services - options.plain}
        self._flow, self._progress = outlet.flow, outlet.flow.progress
        self._deadline = DeadlineFilter(
            options.timed,
            self._progress.throughput.bytes_per_s,
            self._left_bytes,
            self._compressions.get,
        )
        self._thread = on_thread(self._run, name=self.name)

    # -- requests (any thread) ------------------------------------------------------------

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
        """Accept an attempt, or return False. Never blocks. With `more`, `send` must follow."""
        if service not in self.services or self._queue.qsize() >= _QUEUE_LIMIT:
            return False
        now = time.monotonic()
        attempt = OpenAttempt(
            service, request_id, payload, len(payload), now, now + remaining_s, handling
        )
        knows_rate = self._progress.throughput.spans  # rarely: only after a queue was measured
        if knows_rate and not self._deadline.may_arrive(attempt, remaining_s, now, self._before):
            return False
        if not self.window.admit(attempt) and not self._displace(attempt):
            return False
        mark = self._credit.take(attempt.size)
        if mark is None:
            self.send()
            attempt.mark = self._credit.queue(attempt.size)
            self._queue.put(attempt)
            return True
        # It cannot block, so the hop to another thread is avoided.
        attempt.mark = mark
        together = more or self._batch.attempts
        if together and attempt.size <= batch_frames.ENTRY_BYTES_LIMIT:
            self._send_together(self._batch.add(attempt))
        else:
            attempt.payload = None
            try:
                self._publish(attempt, payload, max(remaining_s, 0.0))
            except Exception as error:  # whatever it is, the attempt must end
                self._lose(error, attempt)
        if together and not more:
            self.send()
        return True

    def send(self) -> None:
        """Send attempts offered with `more`. Never blocks: they are small and have credit."""
        if self._batch.attempts:
            self._send_together(self._batch.take())

    def _send_together(self, attempts: Sequence[OpenAttempt]) -> None:
        if len(attempts) < 2 or self._flow.thin:  # on a slow link, each is compressed
            for attempt in attempts:
                self._send_or_lose(attempt)
            return
        now = time.monotonic()
        parts = []
        for attempt in attempts:
            payload = attempt.payload  # read once, as in `_send`
            if payload is not None and self.window.holds(attempt):
                attempt.payload = None
                left_s = self._left_there_s(max(attempt.deadline - now, 0.0))
                parts.append((attempt.request_id, left_s, attempt.handling, payload))
                self._unanswered.add(attempt)
            else:
                self._skipped(attempt)
        if not parts:
            return
        header, content = batch_frames.encode_requests(parts, self.origin, seen=self._seen)
        try:
            self.outlet.publish(attempts[0].service, content, header)
        except Exception as error:  # whatever it is, the attempts must end
            self._lose(error, *attempts)

    def _before(self, service: str) -> list[OpenAttempt]:
        if service in self.options.latest:
            return []
        return [one for one in self.window.attempts() if one.payload is not None]

    def _left_bytes(self, now: float, bytes_per_s: float) -> float:
        """Return the bytes sent that have not arrived: in the kernel, and in Zenoh above it."""
        since, held = self._held_by_zenoh
        left = max(0.0, held - bytes_per_s * (now - since))
        return left + self._progress.left_bytes(now, bytes_per_s)

    def _displace(self, attempt: OpenAttempt) -> bool:
        """Admit a newer attempt in place of the stalest unsent one, if its service allows that."""
        stale = self._queue.stalest(attempt)
        if stale is None:
            return False
        self._end(stale, Refusal.SUPERSEDED)
        return self.window.admit(attempt)

    def forget(self, request_id: bytes) -> None:
        """Free the window of a request, even if its sender is stuck."""
        attempt = self.window.forget(request_id)
        if attempt is None:
            return
        sent, now = attempt.payload is None, time.monotonic()
        tell = sent and self.tell_losers
        if tell and self._cancellations.add(request_id, attempt.offered, now):
            self.flush()
        attempt.payload = None
        attempt.elsewhere = sent and now < attempt.deadline
        if self.window.declined and self.window.regained_room():
            self.tell.room()

    def flush(self) -> None:
        """Send cancellations for forgotten, unanswered requests."""
        if self._cancellations and not self._telling:  # there are some
            self._telling = True
            self._queue.put(_TELL)

    def _end(self, attempt: OpenAttempt, refusal: Refusal) -> None:
        self._close(attempt, Answer(attempt.request_id, refusal=refusal))

    def _close(self, attempt: OpenAttempt, answer: Answer) -> bool:
        """End an open attempt with an answer; False if it has already ended."""
        if not self.window.remove(attempt):
            return False
        attempt.payload = None
        answer.service = attempt.service
        self.tell.answered(answer)
        if self.window.declined and self.window.regained_room():
            self.tell.room()
        return True

    # -- the sender thread ----------------------------------------------------------------

    def _run(self) -> None:
        while (attempt := self._queue.get()) is not None:
            if attempt is _TELL:
                self._tell()
            else:
                self._send_or_lose(attempt)
                self._credit.dequeued()
        self.ended()

    def _tell(self) -> None:
        self._telling = False
        try:
            if ids := self._cancellations.take():
                self.outlet.cancel(ids)
        except Exception as error:
            self._lose(error)

    def _send_or_lose(self, attempt: OpenAttempt) -> None:
        try:
            self._send(attempt)
        except Exception as error:  # whatever it is, the attempt must end
            self._lose(error, attempt)

    def _lose(self, error: Exception, *attempts: OpenAttempt) -> None:
        self.outlet.lose(f"sending failed: {error}")
        for attempt in attempts:
            self._end(attempt, Refusal.LOST)

    def _skipped(self, attempt: OpenAttempt) -> None:
        """Report the end of an attempt that was forgotten before it was sent: no answer will."""
        if attempt.forgotten:
            self.tell.late(
                Answer(attempt.request_id, refusal=Refusal.CANCELLED, service=attempt.service)
            )

    def _send(self, attempt: OpenAttempt) -> None:
        payload = attempt.payload  # read once: `forget` may take it away at any moment
        if payload is None or not self.window.holds(attempt):
            self._skipped(attempt)
            return
        remaining_s = attempt.deadline - time.monotonic()
        if remaining_s <= 0 or not self._deadline.may_arrive(
            attempt, remaining_s, time.monotonic()
        ):
            self._end(attempt, Refusal.LOST if remaining_s <= 0 else Refusal.TOO_SLOW)
            self._skipped(attempt)  # if it was forgotten just now
            return
        large = attempt.size >= LARGE_BYTES
        turn = self.gate.take() if large else None
        began = time.monotonic()
        if large:
            self._large_since = self._sending_since = began
            if not self.watched:  # the link's thread checks its progress for a while
                self.watched = True
                self.tell.wake()
        try:
            if self.window.holds(attempt):  # else `close` has ended it, and may not see this send
                attempt.payload = None
                self._publish(attempt, payload, remaining_s)
            else:
                self._skipped(attempt)
        finally:
            self._sending_since = None
            self.gate.give(turn)
        if large:
            self._held_by_zenoh = time.monotonic(), min(attempt.size, _ZENOH_HOLDS_BYTES)
        if time.monotonic() - began > _STUCK_S and not self.outlet.alive():
            self.outlet.lose("it stopped reading, and Zenoh closed the session")

    def _left_there_s(self, remaining_s: float) -> float:
        """Return the replica's time, less the round trip: under overload it ends just in time."""
        return remaining_s - min(self.round_trip_s, remaining_s / 2)

    def _publish(self, attempt: OpenAttempt, payload: bytes, remaining_s: float) -> None:
        compression, rate = self._compressions.get(attempt.service), self._progress.bytes_per_s
        packed = None
        # Not for topics: the next message would overtake one that is being decompressed.
        if compression and rate is not None and not attempt.service.startswith(topic.PREFIX):
            packed = compression.pack(payload, rate)
        reads_packed = attempt.reads_packed = compression is not None
        self._unanswered.add(attempt)
        header = frame.encode_request(
            attempt.request_id,
            self._left_there_s(remaining_s),
            self.origin,
            seen=self._seen,
            packed=packed is not None,
            may_pack=reads_packed and rate is not None and self._flow.thin,
            reads_packed=reads_packed,
            handling=attempt.handling,
        )
        content = payload if packed is None else packed
        self.outlet.publish(attempt.service, content, header)

    # -- answers (Zenoh's threads) --------------------------------------------------------

    def heard(self, stamp: bytes, answers: Iterable[Answer], *, packed: bool = False) -> None:
        """Take answers and their stamp; `packed`: one answer, with a compressed payload."""
        self._seen = stamp
        for answer in answers:
            attempt = self._unanswered.answered(answer.request_id)
            if attempt is None:  # it has already been answered
                if self._unanswered.owed < 0:
                    self.outlet.lose("it sends more answers than it received requests")
                continue
            if answer.payload is not None:
                self._credit.heard(attempt.mark)  # requests of one connection arrive in order
            aside = packed or len(answer.payload or b"") > ASIDE_BYTES
            if aside and self.window.holds(attempt):
                self._take_aside(attempt, answer, packed=packed)
            elif not self._close(attempt, answer):
                self._came_late(attempt, answer)

    def _take_aside(self, attempt: OpenAttempt, answer: Answer, *, packed: bool) -> None:
        """Take an answer that is still wanted on another thread; decompress it if we allowed it."""

        def done(payload: bytes | None) -> None:
            refusal = Refusal.MALFORMED if payload is None else None
            unpacked = replace(answer, payload=payload, refusal=refusal)
            if not self._close(attempt, unpacked):
                self._came_late(attempt, unpacked)

        taken = attempt.reads_packed or not packed
        content = answer.payload or b""
        if not taken or not self._unpacker.put("answers", content, done, packed=packed):
            done(None if packed else content)

    def _came_late(self, attempt: OpenAttempt, answer: Answer) -> None:
        """Take the answer to an attempt that was forgotten, or has ended."""
        self._cancellations.answered(answer.request_id)
        answer.service = attempt.service
        self.tell.late(answer)

    # -- the link's thread ----------------------------------------------------------------

    @property
    def sending(self) -> bool:
        """Whether a large message is being sent."""
        return self._sending_since is not None

    def look(self, now: float) -> float:
        """Track large sends; return how long the current one has taken so far."""
        if self.watched and now - self._large_since > _WATCH_S and not self._queue.qsize():
            self.watched = False
        since = self._sending_since
        return 0.0 if since is None else now - since

    def sweep(self) -> bool:
        """End attempts past their deadline; return whether the replica ignores its requests."""
        now = time.monotonic()
        for attempt in self.window.attempts():
            if attempt.deadline <= now:
                self._end(attempt, Refusal.LOST)
        return self._unanswered.are_ignored(now)

    def close(self) -> None:
        """Accept nothing more and end open attempts as lost. Returns at once; `end` must follow."""
        ended = self.window.close()
        join_at_exit(self._thread)
        for attempt in ended:
            attempt.payload = None
            self.tell.answered(Answer(attempt.request_id, None, Refusal.LOST, attempt.service))

    def end(self) -> None:
        """End the sender thread once its current send is done: within 11 s."""
        self._queue.put(None)
