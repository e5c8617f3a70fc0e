"""Flow control for sending: a byte credit that cannot block, and one large message at a time.

Sending blocks only when the peer reads nothing and all buffers on the path are full: the smallest
send and receive buffers of Linux sockets plus two Zenoh batches, over 200 KB in total. So a thread
that must never block may send less than that. Tested by
tests/link/zenoh/robot/test_memory_bounds.py.

Copies of one large request sent concurrently all arrive late: with 0.92 MB over loopback, the
first of three responses took 2.33 ms one at a time and 3.29 ms concurrently.
"""

from __future__ import annotations

import threading

from fogft.byte_limit import SMALL_BYTES

_FRAME_BYTES = 256  # overhead per payload: key, header, encryption


class Credit:
    """A credit of bytes for one peer: used by sending, regained by its acknowledgements."""

    limit_bytes = 64 << 10

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sent = 0
        self._heard = 0
        self._queued = 0

    def take(self, size: int) -> int | None:
        """Reserve credit for a small send; return its mark, or None if the send might block."""
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
        """Count a send by the thread that may block; until `dequeued`, `take` returns None."""
        with self._lock:
            self._queued += 1
            self._sent += size + _FRAME_BYTES
            return self._sent

    def dequeued(self) -> None:
        """Note that one queued send is done."""
        with self._lock:
            self._queued -= 1

    def heard(self, mark: int | None = None) -> None:
        """Note that everything up to a mark has arrived; without a mark, everything so far."""
        with self._lock:
            self._heard = max(self._heard, self._sent if mark is None else mark)


LARGE_BYTES = 64 << 10  # smaller requests fit into one Zenoh batch


class LargeSendGate:
    """Serializes a robot's large messages over all of its links.

    A send that is stuck loses its turn: a frozen replica delays the others by `patience_s`, once.
    """

    patience_s = 0.005  # how long to wait for another send to finish

    def __init__(self) -> None:
        self._turn = threading.Lock()

    def take(self) -> threading.Lock | None:
        """Wait briefly for a turn; return it, or None to send without one."""
        turn = self._turn
        if turn.acquire(timeout=self.patience_s):
            return turn
        if self._turn is turn:  # its holder is stuck: later sends do not wait for it again
            self._turn = threading.Lock()
        return None

    def give(self, turn: threading.Lock | None) -> None:
        """Give a turn back."""
        if turn is not None:
            turn.release()
