"""A link's open attempts, bounded by number and by bytes. No clock, no Zenoh.

An attempt is in here from the moment it is accepted until it has ended; whoever removes it
reports its end, so that each end is reported once. The offering thread, the sender thread
and Zenoh's threads meet here: each step holds one short lock.

Owns: which attempts are open, and whether there is room. Not here: sending, deadlines.
"""

from __future__ import annotations

import threading
from typing import Generic, Protocol, TypeVar

# 512 small attempts cost less than 1 MB (here and in Zenoh); the bytes are what
# a slow replica can make us hold.
ATTEMPTS_LIMIT = 512
BYTES_LIMIT = 64 << 20


class Attempt(Protocol):
    """What the window must know of an attempt."""

    @property
    def request_id(self) -> bytes:
        """Whose attempt it is."""

    @property
    def size(self) -> int:
        """Bytes that it holds, or makes the replica hold, until it ends."""


A = TypeVar("A", bound=Attempt)


class LinkWindow(Generic[A]):
    """The attempts open on one connection.

    Args:
        limit: The most attempts at once.
        limit_bytes: The most bytes at once; a larger single attempt still gets in alone.
    """

    def __init__(self, limit: int = ATTEMPTS_LIMIT, limit_bytes: int = BYTES_LIMIT) -> None:
        self._limit = limit
        self._limit_bytes = limit_bytes
        self._lock = threading.Lock()
        self._open: dict[bytes, A] = {}
        self._bytes = 0
        self._closed = False
        self._declined = False

    def __len__(self) -> int:
        return len(self._open)

    @property
    def held_bytes(self) -> int:
        """Bytes of all open attempts."""
        return self._bytes

    def admit(self, attempt: A) -> bool:
        """Take an attempt in; False when full, closed, or its request is open already."""
        size = attempt.size
        with self._lock:
            if self._closed or attempt.request_id in self._open:
                return False
            full = len(self._open) >= self._limit or self._bytes + size > self._limit_bytes
            if full and self._open:
                self._declined = True
                return False
            self._open[attempt.request_id] = attempt
            self._bytes += size
            return True

    def attempts(self) -> list[A]:
        """Return what is open now, oldest first."""
        with self._lock:
            return list(self._open.values())

    def holds(self, attempt: A) -> bool:
        """Whether this attempt, and not a later one of its request, is open."""
        return self._open.get(attempt.request_id) is attempt

    def remove(self, attempt: A) -> bool:
        """End an attempt; False when it has ended before."""
        with self._lock:
            if self._open.get(attempt.request_id) is not attempt:
                return False
            del self._open[attempt.request_id]
            self._bytes -= attempt.size
            return True

    def forget(self, request_id: bytes) -> A | None:
        """End the attempt of a request, whichever it is, and return it if there was one."""
        with self._lock:
            attempt = self._open.pop(request_id, None)
            if attempt is not None:
                self._bytes -= attempt.size
            return attempt

    def regained_room(self) -> bool:
        """Whether an attempt was declined for lack of room that is there now. Asks once."""
        if not self._declined:  # the usual case, without the lock
            return False
        with self._lock:
            # A quarter free: a window that is full to the brim is not announced for each slot.
            roomy = len(self._open) <= self._limit * 3 // 4
            if roomy and self._bytes <= self._limit_bytes * 3 // 4:
                self._declined = False
                return True
            return False

    def close(self) -> list[A]:
        """Let nothing more in, and return what was open: it has ended."""
        with self._lock:
            self._closed = True
            ended = list(self._open.values())
            self._open.clear()
            self._bytes = 0
            return ended
