"""This process's TCP connections, inspected and closed behind Zenoh's back.

Zenoh opens the sockets and does not expose them. But the kernel lists this process's descriptors
and counts each connection's bytes. On systems other than Linux, nothing is found.
"""

import contextlib
import ctypes
import fcntl
import os
import socket
import stat
import struct
import termios
import time
from collections.abc import Iterator
from itertools import chain

from fogft.link.socket_progress import Flow

Address = tuple[str, int]

_DESCRIPTORS = "/proc/self/fd"
# From struct tcp_info in linux/tcp.h: round trip and its variation (us), and the bytes that were
# acknowledged, received, and not sent yet.
_INFO = struct.Struct("=68xII44xQQ8xI")
_COUNT = struct.Struct("@i")
_TCP_NOTSENT_LOWAT = 25
_UNSENT_BYTES = 16 << 10
_AT_ONCE = struct.pack("@ii", 1, 0)  # struct linger: closing does not wait, and resets
_NOWHERE = bytes(16)  # struct sockaddr of AF_UNSPEC: connecting to it resets a connection
_libc = ctypes.CDLL(None)
_LOOK_AGAIN_S = 0.01
_others: set[int] = set()  # inodes of sockets other than TCP connections
_OTHERS_LIMIT = 1024


def address(endpoint: str) -> Address:
    """Return host and port of a Zenoh endpoint such as ``tls/[::1]:7447``. Raises ValueError."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    return _plain(host.strip("[]")), int(port.partition("?")[0].partition("#")[0])


def _plain(host: str) -> str:
    return host.removeprefix("::ffff:") if "." in host else host


def connections(port: int) -> Iterator[tuple[Address, socket.socket]]:
    """Yield the connections at a local port: the peer's address, and a duplicate socket."""
    for connection in filter(None, map(_duplicate, _numbers())):
        ends = _ends(connection)
        if ends is None or ends[0][1] != port:
            connection.close()
        else:
            yield ends[1], connection


def listening(port: int) -> socket.socket | None:
    """Return a duplicate of the socket that listens on a port; None if there is none."""
    for connection in filter(None, map(_duplicate, _numbers())):
        with contextlib.suppress(OSError):
            listens = connection.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)
            if listens and connection.getsockname()[1] == port:
                return connection
        connection.close()
    return None


def refuse(port: int) -> None:
    """Stop listening on a port: new connections are refused."""
    if (listener := listening(port)) is not None:
        with listener:
            listener.shutdown(socket.SHUT_RDWR)


class OwnSocket:
    """One connection of this process. Looked up on each use, not kept open."""

    def __init__(self, own: Address, peer: Address) -> None:
        self._own = own
        self._peer = peer
        self._number = -1

    def borrow(self) -> socket.socket | None:
        """Return a duplicate of its socket. Close it soon: it keeps the connection open."""
        for number in chain((self._number,), _numbers()):
            connection = _duplicate(number)
            if connection is None:
                continue
            if _ends(connection) == (self._own, self._peer):
                self._number = number
                return connection
            connection.close()
        return None


def count() -> int:
    """Return how many descriptors this process has open."""
    return len(list(_numbers()))


def _numbers() -> Iterator[int]:
    try:
        yield from map(int, os.listdir(_DESCRIPTORS))
    except OSError:
        return  # not Linux: nothing can be inspected


def _duplicate(number: int) -> socket.socket | None:
    """Return a duplicate of a TCP socket; None if the descriptor is something else."""
    try:
        status = os.fstat(number)
        if status.st_ino in _others or not stat.S_ISSOCK(status.st_mode):
            return None
        connection = socket.socket(fileno=os.dup(number))
    except OSError:
        return None  # closed in between
    if (
        connection.family in (socket.AF_INET, socket.AF_INET6)
        and connection.type == socket.SOCK_STREAM
    ):
        return connection
    connection.close()
    if len(_others) >= _OTHERS_LIMIT:
        _others.clear()
    _others.add(status.st_ino)
    return None


def _ends(connection: socket.socket) -> tuple[Address, Address] | None:
    try:
        own, peer = connection.getsockname(), connection.getpeername()
    except OSError:
        return None  # it listens, or is no longer connected
    return (_plain(own[0]), own[1]), (_plain(peer[0]), peer[1])


def flow(connection: socket.socket) -> Flow | None:
    """Return the kernel's counters of a connection; None if it has none."""
    try:
        info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO.size)
        waiting = fcntl.ioctl(connection, termios.TIOCOUTQ, bytes(_COUNT.size))
    except OSError:
        return None
    if len(info) < _INFO.size:
        return None  # a kernel before 4.6
    rtt_us, variation_us, acknowledged, received, unsent = _INFO.unpack(info)
    return Flow(
        acknowledged=acknowledged,
        received=received,
        outstanding=max(0, _COUNT.unpack(waiting)[0]),
        round_trip_s=(rtt_us + 4 * variation_us) / 1e6,
        unsent=unsent,
    )


def keep_short(connection: socket.socket) -> None:
    """Limit the unsent bytes in the kernel, so that probes overtake large messages."""
    with contextlib.suppress(OSError):
        connection.setsockopt(socket.IPPROTO_TCP, _TCP_NOTSENT_LOWAT, _UNSENT_BYTES)


def end_sending(connection: socket.socket) -> None:
    """Shut down sending on a connection, whatever Zenoh is doing with it.

    Undelivered bytes are dropped when the socket is closed: else a Zenoh thread would wait for the
    peer for up to 10 s. Receiving stays open: if Zenoh learned of the end before a send failed, its
    thread and the thread that waits for room to send would deadlock (docs/design/links.md).
    """
    _drop_when_closed(connection)
    with contextlib.suppress(OSError):  # it ended by itself
        connection.shutdown(socket.SHUT_WR)


def abort(connection: socket.socket) -> None:
    """Reset a connection at both ends; while data is being sent, use `end_sending`."""
    _drop_when_closed(connection)
    _libc.connect(connection.fileno(), _NOWHERE, len(_NOWHERE))


def _drop_when_closed(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):  # it ended by itself
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)


def abort_all(port: int, within_s: float) -> None:
    """Abort the connections at a local port once they are idle or the time is up."""
    deadline = time.monotonic() + within_s
    seen: list[Flow | None] = []
    while time.monotonic() < deadline:
        before, seen = seen, [flow(connection) for connection in _at(port)]
        idle = [one is None or one.outstanding == 0 for one in seen]
        if all(idle) and _received(seen) == _received(before):
            break
        time.sleep(_LOOK_AGAIN_S)
    for connection in _at(port):
        counted = flow(connection)
        busy = counted is not None and counted.outstanding > 0
        (end_sending if busy else abort)(connection)


def _at(port: int) -> Iterator[socket.socket]:
    for _, connection in connections(port):
        with connection:
            yield connection


def _received(flows: list[Flow | None]) -> list[int]:
    return [one.received for one in flows if one is not None]


def end(connection: socket.socket) -> None:
    """Shut down both directions of a connection at once. Under load, see `end_sending`."""
    end_sending(connection)
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RD)
