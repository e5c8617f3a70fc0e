"""Bound the bytes of large messages held at once; small messages neither wait nor count."""

from collections import Counter

SMALL_BYTES = 16 << 10


class ByteLimit:
    """Counts the bytes of large messages held: up to a limit in total, or one of any size.

    Of several robots, each may hold one large message, whatever others hold. Small messages are not
    counted: callers that get many of them skip the check.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.held = 0
        self._large_of: Counter[str] = Counter()  # number held, by robot

    def has_room(self, size: int, robot: str = "") -> bool:
        """Whether one more message may be held."""
        fits = size <= SMALL_BYTES or self.held + size <= self.limit
        return fits or not self._large_of[robot]

    def add(self, size: int, robot: str = "") -> None:
        """Note that a message is held."""
        if size > SMALL_BYTES:
            self.held += size
            self._large_of[robot] += 1

    def remove(self, size: int, robot: str = "") -> None:
        """Note that a message is no longer held."""
        if size > SMALL_BYTES:
            self.held -= size
            self._large_of -= Counter((robot,))  # drops robots that hold none
