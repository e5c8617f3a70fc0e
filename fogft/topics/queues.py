"""Queues of topic messages: at a replica for robots, on the robot for each replica. Pure.

Messages are numbered by their publisher from 1. A robot pulls the messages after the last number
that it has, so messages lost in transit are pulled again.
"""

from collections import deque
from collections.abc import Iterable
from enum import Enum, auto

Numbered = tuple[int, bytes]
_SMALL_BYTES = 1 << 12  # up to this size, many messages may be in flight
_KNOWN = 64  # how many of the last numbers are remembered as published or not
_MASK = (1 << _KNOWN) - 1


class Ring:
    """The last messages that a replica's nodes published; `latched`: a new robot gets them."""

    kept_bytes = 64 << 20  # the limit of their total; the newest is always kept

    def __init__(self, depth: int, *, latched: bool) -> None:
        self._depth = depth
        self._latched = latched
        self._kept: deque[Numbered] = deque()
        self._bytes = 0
        self.last = 0

    def put(self, message: bytes) -> None:
        """Add a message, and drop old ones beyond the limits."""
        self.last += 1
        self._kept.append((self.last, message))
        self._bytes += len(message)
        while len(self._kept) > self._depth or (
            self._bytes > self.kept_bytes and len(self._kept) > 1
        ):
            self._bytes -= len(self._kept.popleft()[1])

    def begin(self) -> int:
        """Return the number after which a new robot begins."""
        return self._kept[0][0] - 1 if self._latched and self._kept else self.last

    def after(self, number: int, limit_bytes: int) -> list[Numbered]:
        """Return messages after a number, oldest first: at least one, and up to `limit_bytes`."""
        found: list[Numbered] = []
        size = 0
        for one in tuple(self._kept):  # another thread may put one meanwhile
            if one[0] > number:
                size += len(one[1])
                if found and size > limit_bytes:
                    break
                found.append(one)
        return found


class Outbox:
    """The messages of a robot's topic to send to one replica, in order; at most `depth` wait."""

    window = 64  # messages in flight; a quarter of that for large ones
    kept_bytes = 64 << 20  # the limit of the waiting messages' total; the newest is always kept

    def __init__(self, depth: int) -> None:
        self._waiting: deque[Numbered] = deque()
        self._depth = depth
        self._open: dict[int, bytes] = {}

    def __len__(self) -> int:
        return len(self._waiting) + len(self._open)

    @property
    def waiting(self) -> bool:
        """Whether a message has not been sent yet."""
        return bool(self._waiting)

    def put(self, number: int, message: bytes) -> int:
        """Add a message; return how many older ones were dropped."""
        self._waiting.append((number, message))
        size = sum(len(one) for _, one in self._waiting)
        gone = 0
        while len(self._waiting) > self._depth or (
            size > self.kept_bytes and len(self._waiting) > 1
        ):
            size -= len(self._waiting.popleft()[1])
            gone += 1
        return gone

    def next(self) -> Numbered | None:
        """Return the next message to send, which counts as in flight; None if none may be sent.

        It waits while messages with higher numbers are in flight: they may have been lost with it,
        and a message that is overtaken by a later one is too late.
        """
        if not self._waiting:
            return None
        small = self._depth > 1 and len(self._waiting[0][1]) <= _SMALL_BYTES
        if len(self._open) >= (self.window if small else max(1, self.window // 4)):
            return None
        if self._open and max(self._open) > self._waiting[0][0]:
            return None
        number, message = self._waiting.popleft()
        self._open[number] = message
        return number, message

    def confirmed(self, number: int) -> None:
        """Note that the replica has a message. Unknown numbers are ignored."""
        self._open.pop(number, None)

    def returned(self, numbers: Iterable[int]) -> None:
        """Requeue undelivered messages, in order."""
        back = [(number, self._open.pop(number)) for number in numbers if number in self._open]
        self._waiting = deque(sorted([*back, *self._waiting]))


class Judgement(Enum):
    """What a replica does with a robot's message."""

    NEW = auto()  # it is to be published
    KNOWN = auto()  # a duplicate: it was published
    LATE = auto()  # a later one was published, so this one never will be


class Seen:
    """Detects duplicate and late messages of one topic at a replica, per robot and session."""

    robots, starts = 256, 4  # how many are remembered; those silent for longest are forgotten

    def __init__(self) -> None:
        # For each session: the last number published, and a bit for each number up to it.
        self._of: dict[str, dict[bytes, tuple[int, int]]] = {}

    def judge(self, robot: str, session: bytes, number: int) -> Judgement:
        """Return what to do with a message; if it is new, it counts as published."""
        starts = self._of[robot] = self._of.pop(robot, {})
        last, published = starts.pop(session, (0, 0))
        ahead = number - last
        if ahead > 0:
            starts[session] = number, (published << min(ahead, _KNOWN) | 1) & _MASK
        else:
            starts[session] = last, published
        for of, most in ((self._of, self.robots), (starts, self.starts)):
            if len(of) > most:
                del of[next(iter(of))]  # type: ignore[arg-type]
        if ahead > 0:
            return Judgement.NEW
        return Judgement.KNOWN if published >> -ahead & 1 else Judgement.LATE
