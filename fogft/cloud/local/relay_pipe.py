"""One direction of a relayed connection: receive, hold back as long as the path is slow, send.

A path is modelled as networks are: a chunk occupies it for its size over the rate, after
those before it, and arrives the delay later. The order is kept whatever changes meanwhile.
"""

from __future__ import annotations

import math
import socket
from collections import deque

MAX_HELD_BYTES = 32 << 20
_CHUNK_S = 0.02  # how much a slow path takes at a time
_MIN_CHUNK_BYTES = 1024
_SLACK_BYTES = 64 << 10


class Shaper:
    """The state of one direction of the path, shared by its connections."""

    def __init__(self) -> None:
        self.delay_s = 0.0
        self.rate: float | None = None
        self.held = 0  # chunks in all its pipes
        self._free_at = 0.0

    def set(self, delay_s: float, rate_bytes_per_s: float | None) -> None:
        """Change the path; what is under way already keeps its time."""
        self.delay_s = delay_s
        self.rate = rate_bytes_per_s or None
        self._free_at = 0.0 if self.rate is None else self._free_at

    @property
    def idle(self) -> bool:
        """Whether nothing is held back now."""
        return self.held == 0

    @property
    def transparent(self) -> bool:
        """Whether the path is as fast as it can be."""
        return self.rate is None and self.delay_s == 0.0

    @property
    def chunk_bytes(self) -> int:
        """How much to receive at once."""
        if self.rate is None:
            return MAX_HELD_BYTES
        return max(_MIN_CHUNK_BYTES, int(self.rate * _CHUNK_S))

    @property
    def room_bytes(self) -> int:
        """How much the path of one connection may hold before the reading stops."""
        if self.rate is None:
            return MAX_HELD_BYTES
        return min(MAX_HELD_BYTES, int(self.rate * (self.delay_s + _CHUNK_S)) + _SLACK_BYTES)

    def arrival(self, size: int, now: float) -> float:
        """Put a chunk on the path; return when it arrives."""
        if self.rate is None:
            return now + self.delay_s
        self._free_at = max(now, self._free_at) + size / self.rate
        return self._free_at + self.delay_s


class Pipe:
    """Bytes from one socket to another, both non-blocking.

    Attributes:
        blocked: The receiver takes no more for now: wait until it can be written to.
        done: The sender has ended and all has been passed on, the end included.
    """

    def __init__(self, source: socket.socket, target: socket.socket, shaper: Shaper) -> None:
        self._source = source
        self._target = target
        self._shaper = shaper
        self._chunks: deque[tuple[float, memoryview]] = deque()
        self._ended = False
        self.held_bytes = 0
        self.blocked = False
        self.done = False

    @property
    def reads(self) -> bool:
        """Whether more may be received now."""
        return not (self._ended or self.blocked) and self.held_bytes < self._shaper.room_bytes

    @property
    def due_at(self) -> float:
        """When the next chunk arrives; never, if none is held or the receiver is blocked."""
        return math.inf if self.blocked or not self._chunks else self._chunks[0][0]

    def pump(self, buffer: memoryview, now: float) -> None:
        """Receive once, and pass on what need not be held back.

        Raises:
            OSError: A side is broken; the connection is over.
        """
        if not self.reads:
            return
        try:
            size = self._source.recv_into(buffer[: self._shaper.chunk_bytes])
        except BlockingIOError:
            return
        if size == 0:
            self._ended = True
            self._finish()
            return
        if self._shaper.transparent and not self._chunks:
            sent = self._send(buffer[:size])
            if sent < size:
                self._hold(now, memoryview(bytes(buffer[sent:size])))
                self.blocked = True
            return
        arrives_at = self._shaper.arrival(size, now)
        self._hold(arrives_at, memoryview(bytes(buffer[:size])))

    def flush(self, now: float) -> None:
        """Pass on what has arrived.

        Raises:
            OSError: The receiver is broken; the connection is over.
        """
        self.blocked = False
        while self._chunks and self._chunks[0][0] <= now:
            arrived_at, chunk = self._chunks[0]
            sent = self._send(chunk)
            self.held_bytes -= sent
            if sent < len(chunk):
                self._chunks[0] = (arrived_at, chunk[sent:])
                self.blocked = True
                return
            self._chunks.popleft()
            self._shaper.held -= 1
        self._finish()

    def discard(self) -> None:
        """Forget what is held: the connection is over."""
        self._shaper.held -= len(self._chunks)
        self._chunks.clear()
        self.held_bytes = 0

    def _send(self, chunk: memoryview) -> int:
        try:
            return self._target.send(chunk)
        except BlockingIOError:
            return 0

    def _hold(self, arrives_at: float, chunk: memoryview) -> None:
        self._chunks.append((arrives_at, chunk))
        self._shaper.held += 1
        self.held_bytes += len(chunk)

    def _finish(self) -> None:
        if self._ended and not self._chunks and not self.done:
            self.done = True
            self._target.shutdown(socket.SHUT_WR)
