"""A connection's records of its attempts: open, unanswered, waiting to be sent, or cancelled.

Whoever removes an attempt from its window reports its end, so that each end is reported once. The
offering thread, the sender thread and Zenoh's threads all use this; each step holds a lock briefly.

A cancellation costs a message. So it is sent at once only if the request was sent `WORTH_S` ago or
earlier and no cancellation was sent at once for `EVERY_S`; else with the next flush, and not at
all if the answer comes first.
"""

import heapq
import threading
from collections.abc import Collection
from dataclasses import dataclass
from itertools import count
from queue import SimpleQueue

from fogft.byte_limit import SMALL_BYTES, ByteLimit
from fogft.link import batch_frames
from fogft.link.frame import CANCEL_LIMIT
from fogft.requests.load import Handling

# 512 small attempts cost less than 1 MB (here and in Zenoh); the limit in bytes bounds
# what a slow replica can make us hold.
ATTEMPTS_LIMIT = 512
BYTES_LIMIT = 64 << 20


@dataclass(slots=True, eq=False)
class OpenAttempt:
    """A request on one connection. Times are monotonic seconds."""

    service: str
    request_id: bytes
    payload: bytes | None  # None once it was sent, or is no longer wanted
    size: int
    offered: float
    deadline: float
    handling: Handling = Handling.NORMAL
    mark: int = 0  # bytes that the connection had sent, this attempt included (`credit`)
    reads_packed: bool = False  # the answer may be compressed
    elsewhere: bool = False  # it was sent, and another replica answered its request in time
    forgotten: bool = False  # it is no longer wanted, and was not sent


class LinkWindow:
    """The attempts open on one connection, bounded; `standing` is extra room for topic pulls."""

    def __init__(self, standing: int = 0) -> None:
        self.limit = ATTEMPTS_LIMIT + standing
        self.large = ByteLimit(BYTES_LIMIT)
        self._lock = threading.Lock()
        self._open: dict[bytes, OpenAttempt] = {}
        self._closed = False
        self.declined = False  # whether an attempt was declined for lack of room

    def __len__(self) -> int:
        return len(self._open)

    def admit(self, attempt: OpenAttempt) -> bool:
        """Add an attempt; False if full, closed, or its request is already open."""
        with self._lock:
            if self._closed or attempt.request_id in self._open:
                return False
            large = attempt.size > SMALL_BYTES
            if len(self._open) >= self.limit or (large and not self.large.has_room(attempt.size)):
                self.declined = True
                return False
            self._open[attempt.request_id] = attempt
            if large:
                self.large.add(attempt.size)
            return True

    def attempts(self) -> list[OpenAttempt]:
        """Return the open attempts, oldest first."""
        with self._lock:
            return list(self._open.values())

    def holds(self, attempt: OpenAttempt) -> bool:
        """Whether this attempt, and not a later one of its request, is open."""
        return self._open.get(attempt.request_id) is attempt

    def remove(self, attempt: OpenAttempt) -> bool:
        """End an attempt; False if it has already ended."""
        with self._lock:
            if self._open.get(attempt.request_id) is not attempt:
                return False
            del self._open[attempt.request_id]
            if attempt.size > SMALL_BYTES:
                self.large.remove(attempt.size)
            return True

    def forget(self, request_id: bytes) -> OpenAttempt | None:
        """End the open attempt of a request, if there is one, and return it."""
        with self._lock:
            attempt = self._open.get(request_id)
            if attempt is not None:
                attempt.forgotten = attempt.payload is not None  # set before it is seen to be gone
                del self._open[request_id]
                self.large.remove(attempt.size)
            return attempt

    def regained_room(self) -> bool:
        """Whether there is room again after an attempt was declined; True once per decline."""
        with self._lock:
            # A quarter must be free, so that a full window is not announced slot by slot.
            roomy = len(self._open) <= self.limit * 3 // 4
            if self.declined and roomy and self.large.held <= self.large.limit * 3 // 4:
                self.declined = False
                return True
            return False

    def close(self) -> list[OpenAttempt]:
        """Accept nothing more; end the open attempts and return them."""
        with self._lock:
            self._closed = True
            ended = list(self._open.values())
            self._open.clear()
            self.large.held = 0
            return ended


# A replica ends every request that it takes, cancelled ones too. It ignores requests if it has not
# ended this many in a row that others answered, even this long past their deadlines.
IGNORED_LIMIT = 3
IGNORED_AFTER_S = 10.0


class Unanswered:
    """The requests sent on one connection and not answered yet, by id."""

    # The window holds 512; this bounds forgotten requests that a replica never answers.
    limit = 8192

    def __init__(self) -> None:
        self._attempts: dict[bytes, OpenAttempt] = {}
        self._lock = threading.Lock()
        self._sent = 0
        self._answered = 0  # counted by one thread, Zenoh's
        self._ignored = 0  # in a row

    @property
    def owed(self) -> int:
        """Requests sent minus answers received, answers to unknown ids included."""
        return self._sent - self._answered

    def __len__(self) -> int:
        return len(self._attempts)

    def add(self, attempt: OpenAttempt) -> None:
        """Note an attempt that is about to be sent; it replaces an earlier one of its request."""
        with self._lock:
            self._sent += 1
        self._attempts[attempt.request_id] = attempt
        if len(self._attempts) > self.limit:
            for id in list(self._attempts)[: self.limit // 8]:
                self._attempts.pop(id, None)

    def answered(self, request_id: bytes) -> OpenAttempt | None:
        """Return the attempt that an answer is for, once; None if no attempt awaits it."""
        self._answered += 1
        attempt = self._attempts.pop(request_id, None)
        if attempt is not None:
            self._ignored = 0
        return attempt

    def are_ignored(self, now: float) -> bool:
        """Whether the replica ignores the requests that it takes, as far as is known now."""
        for attempt in list(self._attempts.values()):
            if attempt.elsewhere and now >= attempt.deadline + IGNORED_AFTER_S:
                attempt.elsewhere = False  # counted once
                self._ignored += 1
        return self._ignored >= IGNORED_LIMIT


class BatchBuffer:
    """Small attempts of one service that wait to be sent in one message. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self.attempts: list[OpenAttempt] = []
        self._bytes = 0

    def add(self, attempt: OpenAttempt) -> list[OpenAttempt]:
        """Add a small attempt; return the earlier ones to send now if it does not fit with them."""
        with self._lock:
            full = (
                len(self.attempts) >= batch_frames.LIMIT
                or self._bytes + attempt.size > batch_frames.BYTES_LIMIT
                or (self.attempts and self.attempts[0].service != attempt.service)
            )
            leaving = self.take() if full else []
            self.attempts.append(attempt)
            self._bytes += attempt.size
            return leaving

    def take(self) -> list[OpenAttempt]:
        """Remove and return the held attempts, in order."""
        with self._lock:
            taken, self.attempts, self._bytes = self.attempts, [], 0
            return taken


WORTH_S = 0.005
EVERY_S = 0.01  # under load each answer has a loser: their cancellations are sent together


class Cancellations:
    """Ids of cancelled requests that have not been sent to the replica yet. Any thread."""

    def __init__(self) -> None:
        self._ids: dict[bytes, None] = {}
        self._told_at = float("-inf")

    def __bool__(self) -> bool:
        return bool(self._ids)

    def add(self, request_id: bytes, sent_at: float, now: float) -> bool:
        """Cancel a request sent at `sent_at`; return whether to tell the replica at once."""
        if len(self._ids) < CANCEL_LIMIT:  # what fits into one message; others are not sent
            self._ids[request_id] = None
        if now - sent_at < WORTH_S or now - self._told_at < EVERY_S:
            return False
        self._told_at = now
        return True

    def answered(self, request_id: bytes) -> None:
        """Note that the answer came anyway, so nothing needs to be sent."""
        self._ids.pop(request_id, None)

    def take(self) -> list[bytes]:
        """Remove and return the ids to send now."""
        return [id for id in list(self._ids) if self._ids.pop(id, self) is None]


class SendQueue:
    """A queue of attempts, the newest of `latest` services first. None ends the sender thread."""

    def __init__(self, latest: Collection[str] = ()) -> None:
        self._queued: SimpleQueue[OpenAttempt | str | None] = SimpleQueue()
        self.qsize = self._queued.qsize
        self._lock = threading.Lock()
        self._order = count()
        self._waiting = {service: list[tuple[float, int, OpenAttempt]]() for service in latest}

    def put(self, attempt: OpenAttempt | None) -> None:
        """Queue an attempt; None ends the sender after everything queued before it."""
        waiting = self._waiting.get(attempt.service) if attempt is not None else None
        if attempt is None or waiting is None:
            self._queued.put(attempt)
            return
        with self._lock:
            heapq.heappush(waiting, (-attempt.deadline, next(self._order), attempt))
        self._queued.put(attempt.service)

    def get(self) -> OpenAttempt | None:
        """Wait for the next one."""
        turn = self._queued.get()
        if not isinstance(turn, str):
            return turn
        with self._lock:
            return heapq.heappop(self._waiting[turn])[2]

    def stalest(self, than: OpenAttempt) -> OpenAttempt | None:
        """Return the oldest waiting attempt that this newer one of its service may replace."""
        with self._lock:
            waiting = [entry for entry in self._waiting.get(than.service, ()) if entry[2].payload]
        oldest = max(waiting, default=None)
        return oldest[2] if oldest is not None and oldest[2].deadline < than.deadline else None
