"""Bound the bytes of large messages held at once; small ones neither wait for them nor bar them."""

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
