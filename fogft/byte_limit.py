"""Bound the bytes of large messages held at once; small messages neither wait nor count."""

from collections import Counter

SMALL_BYTES = 16 << 10


class ByteLimit:
    """Counts the bytes of large messages held: up to a limit in total, or one of any size.

    Small messages are not counted: callers that get many of them skip the check.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.held = 0

    def has_room(self, size: int) -> bool:
        """Whether one more message may be held."""
        return size <= SMALL_BYTES or not self.held or self.held + size <= self.limit

    def add(self, size: int) -> None:
        """Note that a message is held."""
        if size > SMALL_BYTES:
            self.held += size

    def remove(self, size: int) -> None:
        """Note that a message is no longer held."""
        if size > SMALL_BYTES:
            self.held -= size


class SharedByteLimit(ByteLimit):
    """A limit shared by several robots: each may hold one large message, whatever others hold."""

    def __init__(self, limit: int) -> None:
        super().__init__(limit)
        self._large_of: Counter[str] = Counter()  # number held, by robot

    def has_room_for(self, robot: str, size: int) -> bool:
        """Whether one more message of a robot may be held."""
        return self.has_room(size) or not self._large_of[robot]

    def hold(self, robot: str, size: int) -> None:
        """Note that a message is held."""
        if size > SMALL_BYTES:
            self.add(size)
            self._large_of[robot] += 1

    def let_go(self, robot: str, size: int) -> None:
        """Note that a message is no longer held."""
        if size > SMALL_BYTES:
            self.remove(size)
            self._large_of -= Counter((robot,))  # drops robots that hold none
