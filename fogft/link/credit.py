"""How many bytes may be sent before sending could block. Pure.

Sending blocks only when the peer takes nothing and all buffers on the way are full. So a few
bytes may be sent from a thread that must never block, as long as all that was sent since the
peer's last sign is less than those buffers surely hold: the smallest send buffer of a Linux
socket with the smallest receive buffer, and two batches of Zenoh's, together over 200 KB.

Owns: the sum. Not here: what a sign is. Kept true by tests/link/zenoh/robot/test_memory_bounds.py.
"""

from __future__ import annotations

import threading

CREDIT_BYTES = 64 << 10
SMALL_BYTES = 16 << 10
_FRAME_BYTES = 256  # what travels with a payload: key, header, encryption


class Credit:
    """A credit of bytes for one peer: used by sending, regained by what the peer acknowledges."""

    def __init__(self, limit: int = CREDIT_BYTES) -> None:
        self._limit = limit
        self._lock = threading.Lock()
        self._sent = 0
        self._heard = 0
        self._queued = 0

    def take(self, size: int) -> int | None:
        """Reserve a small send; return its mark, or None where it might block."""
        if size > SMALL_BYTES:
            return None
        with self._lock:
            if self._queued:
                return None
            mark = self._sent + size + _FRAME_BYTES
            if mark - self._heard > self._limit:
                return None
            self._sent = mark
            return mark

    def queue(self, size: int) -> int:
        """Count a send that may block; return its mark. Until `dequeued` nothing is taken."""
        with self._lock:
            self._queued += 1
            self._sent += size + _FRAME_BYTES
            return self._sent

    def dequeued(self) -> None:
        """The thread that may block has done with one."""
        with self._lock:
            self._queued -= 1

    def heard(self, mark: int | None = None) -> None:
        """A sign came that all up to a mark has arrived; without a mark, all so far."""
        with self._lock:
            self._heard = max(self._heard, self._sent if mark is None else mark)
