"""The simulated network path to one machine: a TCP relay with delay, rate, blackhole and reset.

One thread, one epoll, no callbacks: the machine calls `step` in its own loop. Without a
fault a chunk is received into one shared buffer and sent from there at once; what the other
side does not take stops the reading, so backpressure is the kernel's own.

A connection that comes before the server listens for the first time waits for it, as a
machine's does that still boots; later a refused one is reset.

Owns: sockets and connections. Not here: how bytes are delayed (`relay_pipe`) and who sets
the faults (`chaos`).
"""

from __future__ import annotations

import contextlib
import errno
import select
import socket
import struct
import time
from collections.abc import Callable

from fogft.cloud.local.faults import LinkFaults
from fogft.cloud.local.relay_pipe import Pipe, Shaper

BUFFER_BYTES = 1 << 20
RETRY_S = 0.05
_BACKLOG = 128
_RESET = struct.pack("ii", 1, 0)  # SO_LINGER with no time: close sends RST


class _Connection:
    """A client, the server, and a pipe each way. Side 0 is the client's, 1 the server's."""

    def __init__(self, client: socket.socket) -> None:
        self.sides: list[socket.socket | None] = [client, None]
        self.pipes: tuple[Pipe, Pipe] | None = None
        self.masks = [0, 0]
        self.retry_at = 0.0


class Relay:
    """Relays the connections of one machine, as slow or broken as its faults say.

    Args:
        upstream: Where the server listens, or will.
    """

    def __init__(
        self, upstream: tuple[str, int], *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._upstream = upstream
        self._clock = clock
        self._buffer = memoryview(bytearray(BUFFER_BYTES))
        self._faults = LinkFaults()
        self._shapers = (Shaper(), Shaper())
        self._epoll = select.epoll()
        self._by_fd: dict[int, tuple[_Connection, int]] = {}
        self._connections: set[_Connection] = set()
        self._waiting: set[_Connection] = set()
        self._listener = socket.socket()
        self._listener.setblocking(False)
        self._listener.bind(("127.0.0.1", 0))
        self._listener.listen(_BACKLOG)
        self._epoll.register(self._listener, select.EPOLLIN)
        self.reached = False  # whether the server has ever accepted a connection

    @property
    def endpoint(self) -> str:
        """``host:port`` where it listens."""
        host, port = self._listener.getsockname()
        return f"{host}:{port}"

    @property
    def connections(self) -> int:
        """How many connections there are."""
        return len(self._connections)

    @property
    def held_bytes(self) -> int:
        """How much has been received and not yet passed on."""
        return sum(pipe.held_bytes for c in self._connections for pipe in c.pipes or ())

    def set_faults(self, faults: LinkFaults) -> None:
        """Change what is wrong with the path (deadlines already applied)."""
        before, self._faults = self._faults, faults
        for shaper in self._shapers:
            shaper.set(faults.delay_s, faults.rate_bytes_per_s)
        if faults.resets != before.resets:
            for connection in list(self._connections):
                self._drop(connection, reset=True)
        if faults.blackhole != before.blackhole:
            self._epoll.modify(self._listener, 0 if faults.blackhole else select.EPOLLIN)
            for connection in list(self._connections):
                self._watch(connection)

    def step(self, timeout_s: float) -> None:
        """Pass on what can be passed on now; wait at most so long for something to do."""
        now = self._clock()
        for fd, events in self._epoll.poll(self._wait_s(timeout_s, now)):
            if fd == self._listener.fileno():
                self._accept()
                continue
            found = self._by_fd.get(fd)
            if found is not None:
                self._serve(*found, events)
        if self._shapers[0].idle and self._shapers[1].idle and not self._waiting:
            return
        self._flush_and_retry()

    def close(self) -> None:
        """End all connections and stop listening."""
        for connection in list(self._connections):
            self._drop(connection, reset=True)
        self._listener.close()
        self._epoll.close()

    # -- connections ------------------------------------------------------------------------

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:  # nobody more, or out of descriptors
                return
            connection = _Connection(client)
            _prepare(client)
            self._connections.add(connection)
            self._connect(connection)

    def _connect(self, connection: _Connection) -> None:
        server = socket.socket()
        _prepare(server)
        connection.sides[1] = server
        result = server.connect_ex(self._upstream)
        if result in (0, errno.EINPROGRESS):
            self._watch(connection)
        else:
            self._refused(connection)

    def _refused(self, connection: _Connection) -> None:
        """The server does not listen: wait for its first time."""
        server, connection.sides[1] = connection.sides[1], None
        if server is not None:
            self._forget(connection, 1, server)
            server.close()
        if self.reached:
            self._drop(connection, reset=True)
            return
        connection.retry_at = self._clock() + RETRY_S
        self._waiting.add(connection)
        self._watch(connection)

    def _connected(self, connection: _Connection) -> None:
        client, server = connection.sides
        assert client is not None
        assert server is not None
        if server.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) != 0:
            self._refused(connection)
            return
        self.reached = True
        up, down = self._shapers
        connection.pipes = (Pipe(client, server, up), Pipe(server, client, down))
        self._watch(connection)

    def _serve(self, connection: _Connection, side: int, events: int) -> None:
        """Do what a socket is ready for. `side` both sends pipe `side` and takes the other."""
        if connection.pipes is None:
            if side == 1:
                self._connected(connection)
            else:  # it gave up while it waited
                self._drop(connection)
            return
        try:
            if events & select.EPOLLOUT:
                connection.pipes[1 - side].flush(self._clock())
            if events & ~select.EPOLLOUT:
                connection.pipes[side].pump(self._buffer, self._clock())
        except OSError:
            self._drop(connection, reset=True)
            return
        if connection.pipes[0].done and connection.pipes[1].done:
            self._drop(connection)
        else:
            self._watch(connection)

    def _flush_and_retry(self) -> None:
        if self._faults.blackhole:
            return
        now = self._clock()
        for connection in list(self._connections):
            if connection.pipes is None:
                if connection in self._waiting and now >= connection.retry_at:
                    self._waiting.discard(connection)
                    self._connect(connection)
                continue
            if any(pipe.due_at <= now for pipe in connection.pipes):
                self._serve(connection, 0, select.EPOLLOUT)
                if connection.pipes and connection in self._connections:
                    self._serve(connection, 1, select.EPOLLOUT)

    def _wait_s(self, timeout_s: float, now: float) -> float:
        if self._faults.blackhole or (self._shapers[0].idle and self._shapers[1].idle):
            return timeout_s
        due = min(
            (pipe.due_at for c in self._connections for pipe in c.pipes or ()),
            default=now + timeout_s,
        )
        return min(timeout_s, max(0.0, due - now))

    # -- what epoll watches -----------------------------------------------------------------

    def _watch(self, connection: _Connection) -> None:
        """Ask for just the events that can be served now.

        A socket with none is taken out altogether, since epoll would report a hang-up of
        it without end.
        """
        for side, sock in enumerate(connection.sides):
            if sock is None:
                continue
            mask = self._mask(connection, side)
            if mask == connection.masks[side]:
                continue
            if not mask:
                self._forget(connection, side, sock)
            elif connection.masks[side]:
                self._epoll.modify(sock, mask)
            else:
                self._epoll.register(sock, mask)
                self._by_fd[sock.fileno()] = (connection, side)
            connection.masks[side] = mask

    def _mask(self, connection: _Connection, side: int) -> int:
        if self._faults.blackhole:
            return 0
        if connection.pipes is None:
            if side == 1:
                return select.EPOLLOUT
            return select.EPOLLRDHUP if connection in self._waiting else 0
        mask = select.EPOLLIN if connection.pipes[side].reads else 0
        return mask | (select.EPOLLOUT if connection.pipes[1 - side].blocked else 0)

    def _forget(self, connection: _Connection, side: int, sock: socket.socket) -> None:
        if connection.masks[side]:
            self._epoll.unregister(sock)
            del self._by_fd[sock.fileno()]
            connection.masks[side] = 0

    def _drop(self, connection: _Connection, *, reset: bool = False) -> None:
        self._connections.discard(connection)
        self._waiting.discard(connection)
        for pipe in connection.pipes or ():
            pipe.discard()
        for side, sock in enumerate(connection.sides):
            if sock is None:
                continue
            self._forget(connection, side, sock)
            if reset:
                with contextlib.suppress(OSError):
                    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            sock.close()


def _prepare(sock: socket.socket) -> None:
    sock.setblocking(False)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
