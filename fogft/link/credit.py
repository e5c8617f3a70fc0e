"""What may be sent now: as many bytes as cannot block, and one large message after the other.

Sending blocks only when the peer takes nothing and all buffers on the way are full: the smallest
send and receive buffers of Linux sockets with two batches of Zenoh's, together over 200 KB. So less
than that may be sent from a thread that must never block. Kept true by
tests/link/zenoh/robot/test_memory_bounds.py.

Copies of one large request that leave together all arrive late: with 0.92 MB over loopback the
first of three responses took 2.33 ms in turns and 3.29 ms together.
"""

from __future__ import annotations

import threading

from fogft.byte_limit import SMALL_BYTES

_FRAME_BYTES = 256  # what travels with a payload: key, header, encryption


class Credit:
    """A credit of bytes for one peer: used by sending, regained by what the peer acknowledges."""

    limit_bytes = 64 << 10

    def __init__(self) -> None:
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
            if mark - self._heard > self.limit_bytes:
                return None
            self._sent = mark
            return mark

    def queue(self, size: int) -> int:
        """Count a send for the thread that may block; until `dequeued` nothing is taken."""
        with self._lock:
            self._queued += 1
            self._sent += size + _FRAME_BYTES
            return self._sent

    def dequeued(self) -> None:
        """Note that one blocking send is done."""
        with self._lock:
            self._queued -= 1

    def heard(self, mark: int | None = None) -> None:
        """Note that everything up to a mark has arrived; without a mark, everything so far."""
        with self._lock:
            self._heard = max(self._heard, self._sent if mark is None else mark)


LARGE_BYTES = 64 << 10  # smaller requests fit into one batch of Zenoh's


class LargeSendGate:
    """Lets one large message of a robot be sent at a time, over all links.

    Who is stuck in its turn loses it: a frozen replica delays the others by `patience_s` once.
    """

    patience_s = 0.005  # how long to wait for another's turn to end

    def __init__(self) -> None:
        self._turn = threading.Lock()

    def take(self) -> threading.Lock | None:
        """Wait briefly for a turn; return it, or None to send without one."""
        turn = self._turn
        if turn.acquire(timeout=self.patience_s):
            return turn
        if self._turn is turn:  # whoever has it is stuck: the next do not wait for it again
            self._turn = threading.Lock()
        return None

    def give(self, turn: threading.Lock | None) -> None:
        """Give a turn back."""
        if turn is not None:
            turn.release()
