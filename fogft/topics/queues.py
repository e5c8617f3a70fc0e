"""Messages of a topic that wait: at a replica for its robots, on the robot for each replica. Pure.

Messages are numbered by their publisher from 1. A replica keeps the last ones in a `Ring`; a
robot asks for what comes after the last number that it has, so whatever is lost on the way is
asked for again. On the robot an `Outbox` holds, for one replica, what that has not confirmed.

Owns: which messages are kept, and in what order they go. Not here: sending them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

Numbered = tuple[int, bytes]


class Ring:
    """The last messages that a replica's nodes published."""

    def __init__(self, depth: int, *, latched: bool, kept_bytes: int = 64 << 20) -> None:
        self._depth = depth
        self._latched = latched
        self._limit = kept_bytes
        self._kept: deque[Numbered] = deque()
        self._bytes = 0
        self.last = 0

    def put(self, message: bytes) -> int:
        """Keep a message; return how many older ones had to go."""
        self.last += 1
        self._kept.append((self.last, message))
        self._bytes += len(message)
        gone = 0
        while len(self._kept) > self._depth or (self._bytes > self._limit and len(self._kept) > 1):
            self._bytes -= len(self._kept.popleft()[1])
            gone += 1
        return gone

    def begin(self) -> int:
        """Return the number after which a robot that has nothing yet begins."""
        if self._latched:
            return self._kept[0][0] - 1 if self._kept else self.last
        return self.last

    def after(self, number: int, limit_bytes: int) -> list[Numbered]:
        """Return what comes after a number, oldest first: one message, or up to so many bytes."""
        found: list[Numbered] = []
        size = 0
        for one in self._kept:
            if one[0] > number:
                size += len(one[1])
                if found and size > limit_bytes:
                    break
                found.append(one)
        return found


class Outbox:
    """What one replica is to get of a topic of the robot's, in order."""

    def __init__(self, depth: int, *, window: int = 16, kept_bytes: int = 64 << 20) -> None:
        self._limit = kept_bytes
        self._waiting: deque[Numbered] = deque()
        self._depth = depth
        self._window = window
        self._open: dict[int, bytes] = {}

    def __len__(self) -> int:
        return len(self._waiting) + len(self._open)

    @property
    def waiting(self) -> bool:
        """Whether something is not even under way."""
        return bool(self._waiting)

    def put(self, number: int, message: bytes) -> int:
        """Add a message; return how many older ones had to go."""
        self._waiting.append((number, message))
        size = sum(len(one) for _, one in self._waiting)
        gone = 0
        while len(self._waiting) > self._depth or (size > self._limit and len(self._waiting) > 1):
            size -= len(self._waiting.popleft()[1])
            gone += 1
        return gone

    def next(self) -> Numbered | None:
        """Return what is to be sent now; it counts as under way.

        Nothing while later ones than that are under way: they may have been lost with it, and
        what overtakes a message makes it one that comes too late.
        """
        if not self._waiting or len(self._open) >= self._window:
            return None
        if self._open and max(self._open) > self._waiting[0][0]:
            return None
        number, message = self._waiting.popleft()
        self._open[number] = message
        return number, message

    def confirmed(self, number: int) -> None:
        """The replica has it. Unknown numbers are fine."""
        self._open.pop(number, None)

    def returned(self, numbers: Iterable[int]) -> None:
        """These did not get there: they go again, in order with all that waits."""
        back = [(number, self._open.pop(number)) for number in numbers if number in self._open]
        self._waiting = deque(sorted([*back, *self._waiting]))


class Seen:
    """Drops at a replica what came before, or came after a later one. By robot and its start."""

    def __init__(self, robots: int = 256) -> None:
        self._robots = robots
        self._last: dict[bytes, int] = {}

    def is_new(self, publisher: bytes, number: int) -> bool:
        """Whether a message is to be published; if so, it counts as seen."""
        last = self._last.pop(publisher, 0)
        self._last[publisher] = max(last, number)
        if len(self._last) > self._robots:
            del self._last[next(iter(self._last))]
        return number > last
