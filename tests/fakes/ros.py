"""Nodes in memory that keep the contract of `fogft.ros.port`, for tests of what stands on it.

Nodes of one `MemoryDomain` find each other by service name and type. A delivery waits in
the domain until `pump` runs it, so a test decides what has arrived; with
``MemoryDomain(synchronous=True)`` each call and response pumps by itself. Callbacks run
in the thread that pumps, one at a time, as they do on a take loop.

Payloads are opaque, but shorter than a CDR header they are malformed, as in ROS.
"""

from __future__ import annotations

import itertools
import threading
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

from fogft.errors import RosError
from fogft.ros.port import OnBurst

_HEADER_BYTES = 4


@dataclass(frozen=True)
class _Handle:
    """Whom a response goes to."""

    client: MemoryClient
    ticket: int


class MemoryDomain:
    """Where nodes meet.

    Args:
        synchronous: Deliver at once, in the calling thread.
        types: Names of the types that can be loaded; None for all.
    """

    def __init__(self, *, synchronous: bool = False, types: Collection[str] | None = None) -> None:
        self.synchronous = synchronous
        self.types = types
        self._servers: list[MemoryServer] = []
        self._waiting: deque[Callable[[], None]] = deque()
        self._lock = threading.Lock()
        self._pumping = threading.Lock()

    def node(self, name: str = "node") -> MemoryNode:
        """Create a node."""
        return MemoryNode(self, name)

    def pump(self, limit: int | None = None) -> int:
        """Run what waits to be delivered, and what follows from it; return how many.

        Does nothing, and returns 0, inside a callback: the outer pump goes on. What a
        callback raises comes out here, where `SerialisedNode` logs it; the rest waits on.
        """
        done = 0
        # Look again after each release: another thread may have queued and found it taken.
        while self._waiting and done != limit and self._pumping.acquire(blocking=False):
            try:
                while self._waiting and done != limit:
                    done += 1
                    self._waiting.popleft()()
            finally:
                self._pumping.release()
        return done

    @property
    def waiting(self) -> int:
        """How many deliveries wait."""
        return len(self._waiting)

    def check_type(self, type_name: str) -> None:
        """Raise RosError for a type that cannot be loaded."""
        if self.types is not None and type_name not in self.types:
            raise RosError(f"there is no service type `{type_name}` in this domain")

    def servers(self, name: str, type_name: str) -> list[MemoryServer]:
        """Return who serves a name with a type."""
        with self._lock:
            return [s for s in self._servers if (s.name, s.type_name) == (name, type_name)]

    def offered(self, without: Collection[object]) -> dict[str, str]:
        """Return name -> type of what is served, except by some servers."""
        with self._lock:
            return {s.name: s.type_name for s in self._servers if s not in without}

    def join(self, server: MemoryServer) -> None:
        """Let a server be found."""
        with self._lock:
            self._servers.append(server)

    def leave(self, server: MemoryServer) -> None:
        """Let a server be found no more. Repeatable."""
        with self._lock:
            if server in self._servers:
                self._servers.remove(server)

    def deliver(self, delivery: Callable[[], None]) -> None:
        """Queue a delivery; run it at once where the domain is synchronous."""
        self._waiting.append(delivery)
        if self.synchronous:
            self.pump()


class MemoryServer:
    """`fogft.ros.port.RosServer` in memory."""

    def __init__(
        self,
        domain: MemoryDomain,
        name: str,
        type_name: str,
        on_request: Callable[[bytes, Any], None],
    ) -> None:
        self.name = name
        self.type_name = type_name
        self._domain = domain
        self._on_request = on_request
        self._open = True

    def receive(self, payload: bytes, handle: Any) -> None:
        """Hand a request over; one that comes after `close` is lost, as in ROS."""
        if self._open:
            self._on_request(payload, handle)

    def mismatch(self) -> str:
        """Return nothing: here all understand each other."""
        return ""

    def respond(self, handle: Any, payload: bytes) -> None:
        """Send the serialised response. Nothing happens once the service is withdrawn."""
        _check_payload(payload)
        if self._open:
            self._domain.deliver(lambda: handle.client.receive(handle.ticket, payload))

    def close(self) -> None:
        """Withdraw the service. Repeatable."""
        self._open = False
        self._domain.leave(self)


class MemoryClient:
    """`fogft.ros.port.RosClient` in memory."""

    def __init__(self, domain: MemoryDomain, name: str, type_name: str) -> None:
        self.name = name
        self.type_name = type_name
        self._domain = domain
        self._tickets = itertools.count(1)
        self._pending: dict[int, Callable[[bytes], None]] = {}
        self._open = True

    @property
    def pending(self) -> int:
        """How many responses are awaited."""
        return len(self._pending)

    def is_known(self) -> bool:
        return True

    def available(self) -> bool:
        """Whether somebody serves this name with this type."""
        return self.servers() > 0

    def mismatch(self) -> str:
        """Return nothing: here all understand each other."""
        return ""

    def servers(self) -> int:
        """Count those who serve this name with this type."""
        return len(self._domain.servers(self.name, self.type_name)) if self._open else 0

    def call(self, payload: bytes, on_response: Callable[[bytes], None]) -> int:
        """Send a request to all who serve now; return its ticket."""
        _check_payload(payload)
        if not self._open:
            raise RosError(f"the client of `{self.name}` is closed")
        ticket = next(self._tickets)
        self._pending[ticket] = on_response
        handle = _Handle(self, ticket)
        for server in self._domain.servers(self.name, self.type_name):
            self._domain.deliver(lambda server=server: server.receive(payload, handle))  # type: ignore[misc]
        return ticket

    def receive(self, ticket: int, payload: bytes) -> None:
        """Hand a response over: the first for its ticket, unless forgotten."""
        on_response = self._pending.pop(ticket, None)
        if on_response is not None:
            on_response(payload)

    def forget(self, ticket: int) -> None:
        """Drop a pending request; unknown tickets are ignored."""
        self._pending.pop(ticket, None)

    def close(self) -> None:
        """Withdraw the client. Repeatable."""
        self._open = False
        self._pending.clear()


class MemoryNode:
    """`fogft.ros.port.RosNode` in memory."""

    def __init__(self, domain: MemoryDomain, name: str) -> None:
        self.name = name
        self._domain = domain
        self._made: list[MemoryServer | MemoryClient] = []
        self._open = True

    @property
    def alive(self) -> bool:
        """Whether the node is open."""
        return self._open

    def serve(
        self,
        name: str,
        type_name: str,
        on_request: Callable[[bytes, Any], None],
        on_burst: OnBurst | None = None,
    ) -> MemoryServer:
        """Offer a service."""
        self._check(type_name)
        server = MemoryServer(self._domain, name, type_name, on_request)
        self._domain.join(server)
        self._made.append(server)
        return server

    def client(self, name: str, type_name: str) -> MemoryClient:
        """Create a client of a service."""
        self._check(type_name)
        client = MemoryClient(self._domain, name, type_name)
        self._made.append(client)
        return client

    def look(self) -> None:
        """Nothing here depends on a clock."""

    def offered(self) -> dict[str, str]:
        """Return name -> type of what is served in the domain, but not by this node."""
        return self._domain.offered(without=self._made)

    def _check(self, type_name: str) -> None:
        self._domain.check_type(type_name)
        if not self._open:
            raise RosError("the ROS node is closed")

    def close(self) -> None:
        """Close all that was made here. Repeatable."""
        self._open = False
        for made in self._made:
            made.close()


def _check_payload(payload: bytes) -> None:
    if len(payload) < _HEADER_BYTES:
        raise RosError(f"{len(payload)} bytes are not a serialised message: too short")
