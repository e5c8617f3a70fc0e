"""Bound the bytes of large messages held at once; small ones neither wait for them nor bar them."""

from collections import Counter

SMALL_BYTES = 16 << 10


class ByteLimit:
    """The large messages held, in bytes: within a limit together, or one of any size.

    Small ones change nothing: where many come, callers do not ask about them.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.held = 0

    def has_room(self, size: int) -> bool:
        """Whether a message may be held, too."""
        return size <= SMALL_BYTES or not self.held or self.held + size <= self.limit

    def add(self, size: int) -> None:
        """Note that a message is held."""
        if size > SMALL_BYTES:
            self.held += size

    def remove(self, size: int) -> None:
        """Note that a message is held no longer."""
        if size > SMALL_BYTES:
            self.held -= size


class SharedByteLimit(ByteLimit):
    """The large messages of several robots: each may have one, whatever others hold."""

    def __init__(self, limit: int) -> None:
        super().__init__(limit)
        self._large_of: Counter[str] = Counter()  # how many, by robot

    def has_room_for(self, robot: str, size: int) -> bool:
        """Whether a message of a robot may be held, too."""
        return self.has_room(size) or not self._large_of[robot]

    def hold(self, robot: str, size: int) -> None:
        """Note that a message is held."""
        if size > SMALL_BYTES:
            self.add(size)
            self._large_of[robot] += 1

    def let_go(self, robot: str, size: int) -> None:
        """Note that a message is held no longer."""
        if size > SMALL_BYTES:
            self.remove(size)
            self._large_of -= Counter((robot,))  # which forgets those who have none
