"""Join two TCP connections, and read a new connection's first message.

The kernel moves the bytes (`splice`), so a tunnel costs a robot only two sleeping threads.
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
_LEAST_S = 0.01  # a time-out of 0 would make the socket non-blocking


def receive(
    link: socket.socket, limit_bytes: int, within_s: float = GREETING_TIMEOUT_S
) -> dict[str, Any]:
    """Receive the first message, completely within `within_s`.

    Raises OSError: it did not arrive in time, or the connection broke. EOFError: the peer closed
    the connection first. RecordError: it is not a valid message.
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
    """Make the kernel drop a connection within seconds once its peer is gone."""
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 2)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 5000)


def hang_up(link: socket.socket) -> None:
    """Close a connection in any state, waking a thread that waits on it."""
    shut_down(link)
    link.close()


def shut_down(*links: socket.socket) -> None:
    """Shut connections down; the threads that wait on them close the sockets."""
    for link in links:
        with contextlib.suppress(OSError):
            link.shutdown(socket.SHUT_RDWR)


class Tunnels:
    """Pairs of joined connections: bytes from each are forwarded to the other. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()  # with at least one direction open

    def carry(self, one: socket.socket, other: socket.socket) -> None:
        """Join two connected sockets, and close both when both directions have ended."""
        ends = (one, other)
        for link in ends:
            link.setblocking(True)
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with self._lock:
            self._open.update(ends)
        left = [other, one]  # one entry per open direction; list.pop is atomic
        for source, target in (ends, ends[::-1]):
            try:
                on_thread(self._carry, source, target, left, name="fogft-tunnel")
            except OSError:
                shut_down(*ends)
                self._carry(source, target, left)  # ends at once

    def _carry(
        self, source: socket.socket, target: socket.socket, left: list[socket.socket]
    ) -> None:
        try:
            _splice(source.fileno(), target.fileno())
            target.shutdown(socket.SHUT_WR)  # the other direction may continue
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
    """Forward bytes until the source ends. Raises OSError: either connection is broken."""
    take, put = os.pipe()
    try:
        while count := os.splice(source, put, _CHUNK):
            while count:
                count -= os.splice(take, target, count)
    finally:
        os.close(take)
        os.close(put)
