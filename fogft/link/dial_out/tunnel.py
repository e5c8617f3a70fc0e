"""Join two TCP connections, and read the first message of whoever connects.

The kernel moves the bytes (`splice`), so a tunnel costs a robot two sleeping threads.
"""

import contextlib
import os
import socket
import threading
import time
from typing import Any

from fogft.process import on_thread
from fogft.records import frames

GREETING_TIMEOUT_S = 5.0
_LEAST_S = 0.01  # a time-out of 0 would mean none


def receive(
    link: socket.socket, limit_bytes: int, within_s: float = GREETING_TIMEOUT_S
) -> dict[str, Any]:
    """Receive the first message, the whole of it within the time.

    Raises OSError: it did not come in time, or the connection broke. EOFError: the other party
    left before. RecordError: it is none.
    """
    until = time.monotonic() + within_s
    unframer = frames.Unframer(limit=limit_bytes)
    while True:
        left_s = until - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("its first message did not come in time")
        link.settimeout(max(_LEAST_S, left_s))
        data = link.recv(4096)
        if not data:
            raise EOFError("it closed the connection without a message")
        for message in unframer.feed(data):
            return message


_CHUNK = 64 << 10


def keep_alive(link: socket.socket) -> None:
    """Have the kernel drop a connection within seconds once its peer is gone."""
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 2)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 5000)


def hang_up(link: socket.socket) -> None:
    """End a connection in any state, also for a thread that waits on it."""
    shut_down(link)
    link.close()


def shut_down(*links: socket.socket) -> None:
    """End connections, which the threads that wait on them close."""
    for link in links:
        with contextlib.suppress(OSError):
            link.shutdown(socket.SHUT_RDWR)


class Tunnels:
    """Pairs of connections, the bytes of each carried to the other. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()  # with both directions open, or one

    def carry(self, one: socket.socket, other: socket.socket) -> None:
        """Join two connected sockets, and close both when both directions have ended."""
        ends = (one, other)
        for link in ends:
            link.setblocking(True)
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with self._lock:
            self._open.update(ends)
        left = [other, one]  # directions that go on; list.pop is atomic
        for source, target in (ends, ends[::-1]):
            on_thread(self._carry, source, target, left, name="fogft-tunnel")

    def _carry(
        self, source: socket.socket, target: socket.socket, left: list[socket.socket]
    ) -> None:
        try:
            _splice(source.fileno(), target.fileno())
            target.shutdown(socket.SHUT_WR)  # the other direction may go on
        except (OSError, ValueError):
            shut_down(source, target)
        left.pop()
        if not left:
            with self._lock:
                self._open -= {source, target}
            source.close()
            target.close()

    def close(self) -> None:
        """End all tunnels. Their threads close the sockets."""
        with self._lock:
            shut_down(*self._open)


def _splice(source: int, target: int) -> None:
    """Carry bytes until the source ends. Raises OSError: one of both is broken."""
    take, put = os.pipe()
    try:
        while count := os.splice(source, put, _CHUNK):
            while count:
                count -= os.splice(take, target, count)
    finally:
        os.close(take)
        os.close(put)
