"""The numbered requests that a replica may still need, and the snapshot before them. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True)
class Checkpoint:
    """A service's own snapshot, taken after the request `index`."""

    index: int
    state: bytes


class OrderedLog:
    """Requests by number, consecutive from `start` + 1, bounded by count and bytes."""

    entries_limit = 8192
    bytes_limit = 64 << 20  # of all together; a larger single entry still gets in alone

    def __init__(self, start: int) -> None:
        self.start = start
        self.checkpoint: Checkpoint | None = None
        self._entries: deque[bytes] = deque()
        self.held_bytes = 0  # bytes of all entries, without the checkpoint

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def last(self) -> int:
        """The highest number given."""
        return self.start + len(self._entries)

    @property
    def half_full(self) -> bool:
        """Whether the log is half full: time for a checkpoint."""
        full = len(self._entries) / self.entries_limit, self.held_bytes / self.bytes_limit
        return max(full) >= 0.5

    def has_room(self, size: int) -> bool:
        """Whether a request of this size can be appended."""
        if not self._entries:
            return True
        within = self.held_bytes + size <= self.bytes_limit
        return within and len(self._entries) < self.entries_limit

    def append(self, payload: bytes) -> int:
        """Number a request; ask `has_room` before."""
        self._entries.append(payload)
        self.held_bytes += len(payload)
        return self.last

    def get(self, index: int) -> bytes:
        """Return a request whose number is above `start`, and at most `last`."""
        return self._entries[index - self.start - 1]

    def covers(self, index: int) -> bool:
        """Whether a replica at this index can be brought up to date from the log alone."""
        return self.start <= index <= self.last

    def keep(self, checkpoint: Checkpoint) -> None:
        """Store a newer snapshot, and drop what it covers. An older one is ignored."""
        old = self.checkpoint
        if not self.covers(checkpoint.index) or (old and old.index >= checkpoint.index):
            return
        self.checkpoint = checkpoint
        self.drop(checkpoint.index)

    def drop(self, index: int) -> None:
        """Drop everything up to a number, with any checkpoint before it."""
        while self._entries and self.start < index:
            self.held_bytes -= len(self._entries.popleft())
            self.start += 1
        if self.checkpoint is not None and self.checkpoint.index < self.start:
            self.checkpoint = None
