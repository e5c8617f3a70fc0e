"""The simulated network path to one machine: a TCP relay with delay, rate and blackhole.

A chunk occupies the path for its size divided by the rate, after earlier chunks, and arrives after
the delay, in order even if faults change meanwhile. If the other side stops reading, so does the
relay. The server sees each client's host. A host that floods the port costs other hosts little.
"""

import asyncio
import contextlib
import math
import socket
import struct
import time
from dataclasses import dataclass
from functools import partial

from fogft.cloud.local.faults import LinkFaults
from fogft.records.accepting import oldest_of_most

CHUNK_BYTES = 256 << 10
MAX_HELD_BYTES = 32 << 20
RETRY_S = 0.05
_CHUNK_S = 0.02  # traffic that a slow path reads at a time
_MIN_CHUNK_BYTES = 1024
_SLACK_BYTES = 64 << 10
_YOUNG_LIMIT = 32  # connections that have not reached the server yet
_FIRST_S = 5.0  # for the client's first bytes
_CONNECT_S = 2.0  # for connecting to the server, which may drop packets
_RESET = struct.pack("ii", 1, 0)  # SO_LINGER with no time: close sends RST


class Shaper:
    """One direction of the path, shared by its connections. Data on it keeps its arrival time."""

    def __init__(self) -> None:
        self.delay_s = 0.0
        self.rate = math.inf  # bytes per second
        self._free_at = 0.0

    @property
    def chunk_bytes(self) -> int:
        """How many bytes to receive at once."""
        return max(_MIN_CHUNK_BYTES, int(min(CHUNK_BYTES, self.rate * _CHUNK_S)))

    @property
    def room_bytes(self) -> int:
        """How many bytes one connection may hold before reading stops."""
        if self.rate == math.inf:
            return MAX_HELD_BYTES if self.delay_s else 0
        return int(min(MAX_HELD_BYTES, self.rate * (self.delay_s + _CHUNK_S) + _SLACK_BYTES))

    def arrival(self, size: int, now: float) -> float:
        """Put a chunk on the path; return when it arrives."""
        self._free_at = max(now, self._free_at) + size / self.rate
        return self._free_at + self.delay_s


@dataclass(eq=False)
class _Pipe:
    """Copies bytes between two non-blocking sockets. An empty chunk marks the end."""

    source: socket.socket
    target: socket.socket
    shaper: Shaper
    passes: asyncio.Event

    def __post_init__(self) -> None:
        self._chunks: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()
        self._has_room = asyncio.Event()
        self.held_bytes = 0  # received and not yet passed on

    def put(self, chunk: bytes) -> None:
        """Put a chunk on the path."""
        self._chunks.put_nowait((self.shaper.arrival(len(chunk), time.monotonic()), chunk))
        self.held_bytes += len(chunk)

    async def receive(self) -> None:
        loop = asyncio.get_running_loop()
        chunk = b"-"
        while chunk:
            await self.passes.wait()
            chunk = await loop.sock_recv(self.source, self.shaper.chunk_bytes)
            await self.passes.wait()
            self.put(chunk)
            while self.held_bytes > self.shaper.room_bytes:
                self._has_room.clear()
                await self._has_room.wait()

    async def send(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            arrives_at, chunk = await self._chunks.get()
            if arrives_at > time.monotonic():
                await asyncio.sleep(arrives_at - time.monotonic())
            await self.passes.wait()
            if not chunk:
                self.target.shutdown(socket.SHUT_WR)
                return
            await loop.sock_sendall(self.target, chunk)
            self.held_bytes -= len(chunk)
            self._has_room.set()


class Relay:
    """Relays the connections of one machine, subject to its link faults.

    Its event loop runs only within `step`. Rejects clients whose first bytes are not `begins`.
    """

    def __init__(self, upstream: tuple[str, int], begins: bytes = b"") -> None:
        self._upstream = upstream
        self._begins = begins
        self._young: dict[asyncio.Task[None], str] = {}  # oldest first, with the client's host
        self._shapers = (Shaper(), Shaper())
        self._loop = asyncio.new_event_loop()
        self._passes = asyncio.Event()  # cleared by a blackhole
        self._passes.set()
        self.connections: dict[asyncio.Task[None], tuple[_Pipe, ...]] = {}
        self._listener = socket.create_server(("127.0.0.1", 0), backlog=128)
        self._listener.setblocking(False)
        self.endpoint = f"127.0.0.1:{self._listener.getsockname()[1]}"  # where it listens
        self._accepting = self._loop.create_task(self._accept())
        self.reached = False  # whether the server has ever accepted a connection

    def set_faults(self, faults: LinkFaults) -> None:
        """Apply faults to the path (with deadlines already evaluated)."""
        for shaper in self._shapers:
            shaper.delay_s = faults.delay_s
            shaper.rate = faults.rate_bytes_per_s or math.inf
        if faults.blackhole:
            self._passes.clear()
        else:
            self._passes.set()

    def step(self, for_s: float) -> None:
        """Relay data for a given time."""
        self._loop.run_until_complete(asyncio.sleep(for_s))

    def close(self) -> None:
        """End all connections and stop listening."""
        tasks = [self._accepting, *self.connections]
        for task in tasks:
            task.cancel()
        self._loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
        self._listener.close()
        self._loop.close()

    async def _accept(self) -> None:
        while True:
            try:
                client, (host, _) = await self._loop.sock_accept(self._listener)
            except OSError:  # out of descriptors
                await asyncio.sleep(RETRY_S)
                continue
            connection = self._loop.create_task(self._serve(client, host))
            self.connections[connection] = ()
            self._young[connection] = host
            connection.add_done_callback(partial(self._forget, client))
            if len(self._young) > _YOUNG_LIMIT:
                oldest_of_most(self._young).cancel()
            await asyncio.sleep(0)  # let established connections run, however many arrive

    def _forget(self, client: socket.socket, connection: asyncio.Task[None]) -> None:
        client.close()  # if the task was cancelled before it began
        self._young.pop(connection, None)
        del self.connections[connection]

    async def _serve(self, client: socket.socket, host: str) -> None:
        client.setblocking(False)
        with client, contextlib.ExitStack() as stack:
            sides = [client]
            try:
                await self._passes.wait()
                first = await asyncio.wait_for(self._first_of(client), _FIRST_S)
                server = stack.enter_context(await self._connected(client, host))
                sides.append(server)
                await self._exchange(client, server, first)
            except (OSError, asyncio.TimeoutError, asyncio.CancelledError):
                for side in sides:
                    with contextlib.suppress(OSError):
                        side.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)

    async def _first_of(self, client: socket.socket) -> bytes:
        """Return the client's first bytes, if `begins` is set. Raises OSError: a mismatch."""
        if not self._begins:
            return b""
        first = await self._loop.sock_recv(client, self._shapers[0].chunk_bytes)
        if not self._begins.startswith(first[: len(self._begins)]) or _has_left(client):
            raise ConnectionAbortedError("no client of ours")
        return first

    async def _connected(self, client: socket.socket, host: str) -> socket.socket:
        """Connect to the server; until it first listens, retry: the machine may be booting."""
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while True:
            reached = self.reached  # read first: another connection may set it
            # A new socket each time: a refused one may fail again without trying.
            server = socket.socket()
            server.setblocking(False)
            server.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                server.bind((host, 0))
                connecting = self._loop.sock_connect(server, self._upstream)
                await asyncio.wait_for(connecting, _CONNECT_S)
            except (OSError, asyncio.TimeoutError, asyncio.CancelledError) as error:
                server.close()
                if reached or isinstance(error, asyncio.CancelledError) or _has_left(client):
                    raise
                await asyncio.sleep(RETRY_S)
            else:
                self.reached = True
                return server

    async def _exchange(self, client: socket.socket, server: socket.socket, first: bytes) -> None:
        up, down = self._shapers
        pipes = (_Pipe(client, server, up, self._passes), _Pipe(server, client, down, self._passes))
        if first:
            pipes[0].put(first)
        connection = asyncio.current_task()
        assert connection is not None
        self._young.pop(connection, None)
        self.connections[connection] = pipes
        ways = [asyncio.ensure_future(way) for p in pipes for way in (p.receive(), p.send())]
        try:
            await asyncio.gather(*ways)
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)


def _has_left(client: socket.socket) -> bool:
    try:
        return not client.recv(1, socket.MSG_PEEK)
    except BlockingIOError:
        return False
