"""The services and clients of a node, and their threading rules.

The take loop calls `drain` and `destroy`; any thread may call everything else. Each entity has
one lock: for *send and insert*, so that no response arrives before its request is registered,
and for the C message that sending uses.

Owns: pending requests, the order of sending and closing.
Not here: the loop (`node`), bytes (`serialised`).
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Any

from fogft.counters import Counters
from fogft.errors import RosError
from fogft.ros.pacing.pacer import EMPTY_LIST, NodeProbes, Pacer
from fogft.ros.port import OnBurst, RosClient
from fogft.ros.serialised import ClientEnd, ServiceEnd

log = logging.getLogger(__name__)

_PENDING_LIMIT = 16_384  # calls of one client that have no answer
BURST = 128  # messages taken from one entity before the others get their turn
_ASK_EVERY_S, _ASK_LIMIT_S = 0.5, 5.0


@dataclass(eq=False)
class Server:
    """A service of a node (`fogft.ros.port.RosServer`)."""

    service: Any
    end: ServiceEnd
    on_request: Callable[[bytes, Any], None]
    withdraw: Callable[[Server], None]
    _: KW_ONLY
    on_burst: OnBurst
    probes: NodeProbes
    mismatch: Callable[[], str] = str

    def __post_init__(self) -> None:
        self.handle = self.service.handle
        self.take = self.end.take
        self._end: ServiceEnd | None = self.end
        self._counters = Counters()
        self._in_bursts = False  # several came together the last time
        self._lock = threading.Lock()
        self._pacer = Pacer(self._send, self.probes, self.service.service_name)
        self.respond = self._pacer.respond  # paces bursts to the client

    def _send(self, handle: Any, payload: bytes) -> None:
        with self._lock:
            if self._end is not None:
                self._end.respond(handle, payload)

    def close(self) -> None:
        """Withdraw the service; idempotent. On return it is gone, unless the take loop called."""
        self.withdraw(self)

    def drain(self) -> None:
        """Deliver received messages. Take loop only.

        If requests came one at a time lately, the first is delivered before ROS is asked for
        another: it is not part of a burst that begins with it.
        """
        together = not self._in_bursts  # `taken` below then comes right after the first
        taken = self._next()
        if taken is not None and not self._in_bursts:
            self._deliver(taken)
            taken = self._next()
        if taken is None:
            return
        following = self._next()
        self._in_bursts = following is not None
        if following is None:
            self._deliver(taken, together=together)
            return
        self._tell_burst(True)
        try:
            self._deliver(taken, together=together)
            for _ in range(BURST - 2):
                self._deliver(following, together=True)
                following = self._next()
                if following is None:
                    return
            self._deliver(following, together=True)
        finally:
            self._tell_burst(False)

    def _next(self) -> tuple[bytes, Any] | None:
        try:
            return self.take()
        except RosError as error:
            self._counters.warn(log, "unreadable", "%s: %s", self.service.srv_name, error.message)
            return None

    def _deliver(self, taken: tuple[bytes, Any], *, together: bool = False) -> None:
        self._pacer.requested(taken[1], together=together)
        try:
            self.on_request(*taken)
        except Exception:
            log.exception("%s: a request was lost", self.service.srv_name)

    def _tell_burst(self, begins: bool) -> None:
        try:
            self.on_burst(begins)
        except Exception:
            log.exception("%s: the end of a burst was not taken", self.service.srv_name)

    def destroy(self, node: Any) -> None:
        """Free all resources. Take loop only, once, when no wait set holds the handle."""
        self._pacer.close()
        with self._lock:
            end, self._end = self._end, None
        if end is not None:
            end.close()
            node.destroy_service(self.service)


@dataclass(eq=False)
class ReadinessProbe:
    """Tests whether a service's server has discovered a client; until then rmw drops responses.

    A process announces its readers in order of creation. So the server's node answers a client
    that was created later only if it knows the earlier one, too.

    Args:
        find: Returns the name of a service of that node that changes nothing and takes an empty
            list; None while it is not discovered, empty if there is none.
        make: Creates a client of that service.
    """

    find: Callable[[], str | None]
    make: Callable[[str], RosClient]
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._servers, self._passed = 0, True
        self._ask_at = self._ends_at = 0.0
        self._client: RosClient | None = None

    def passed(self, servers: int) -> bool:
        """Return whether it has, or that cannot be told; `servers`: their count. About 10 Hz."""
        now = self.clock()
        if servers > self._servers:  # a new one has been discovered
            self._passed, self._ask_at, self._ends_at = False, now, now + _ASK_LIMIT_S
        self._servers = servers
        if not self._passed and now >= self._ask_at:
            self._ask(now)
        if self._passed and self._client is not None:
            self._client.close()
            self._client = None
        return self._passed

    def _ask(self, now: float) -> None:
        if now >= self._ends_at:
            self._passed = True
            return
        if self._client is None:
            name = self.find()
            self._passed = name == ""
            self._client = self.make(name) if name else None
        if self._client is not None:
            self._ask_at = now + _ASK_EVERY_S
            self._client.call(EMPTY_LIST, self._heard)

    def _heard(self, answer: bytes) -> None:
        self._passed = True


class Client:
    """A client of a node (`fogft.ros.port.RosClient`)."""

    def __init__(
        self,
        client: Any,
        end: ClientEnd,
        withdraw: Callable[[Client], None],
        count: Callable[[str], int],
        *,
        mismatch: Callable[[], str] = str,
        probe: ReadinessProbe | None = None,
    ) -> None:
        self.handle = client.handle
        self._probe = probe
        self._mismatch = mismatch
        self._trouble: tuple[int, str] = 0, ""  # with this number of servers
        self._count = count
        self._client = client
        self._end: ClientEnd | None = end
        self.take = end.take
        self._withdraw = withdraw
        self._pending: dict[int, Callable[[bytes], None]] = {}
        self._counters = Counters()
        self._lock = threading.Lock()

    def available(self) -> bool:
        """Whether discovery has found a server."""
        with contextlib.suppress(Exception):  # rclpy's InvalidHandle: withdrawn meanwhile
            return bool(self._client.service_is_ready())
        return False

    def is_known(self) -> bool:
        """Return whether the server has discovered this client, or that cannot be determined."""
        with contextlib.suppress(RosError):  # it is closed, or cannot be asked now
            return self._probe is None or self._probe.passed(self.servers())
        return False

    def servers(self) -> int:
        """Count the servers that discovery lists, dead ones included until their lease ends."""
        with contextlib.suppress(Exception):  # rclpy's InvalidHandle: withdrawn meanwhile
            return self._count(self._client.srv_name) if self._end is not None else 0
        return 0

    def mismatch(self) -> str:
        """Return why none of the servers can be called; else empty."""
        count = self.servers()
        if not count or count != self._trouble[0]:
            self._trouble = count, self._mismatch()
        return self._trouble[1]

    def call(self, payload: bytes, on_response: Callable[[bytes], None]) -> int:
        """Send a serialised request; return its ticket."""
        end = self._end
        if end is not None:
            end.check(payload)  # not under the lock: of a large one this takes seconds
        with self._lock:
            if self._end is None:
                raise RosError(f"the client of `{self._client.srv_name}` is closed")
            ticket = self._end.send(payload)
            self._pending[ticket] = on_response
            if len(self._pending) > _PENDING_LIMIT:  # silent servers must not fill the memory
                del self._pending[next(iter(self._pending))]
        return ticket

    def forget(self, ticket: int) -> None:
        """Drop a pending request; unknown tickets are ignored."""
        with self._lock:
            self._pending.pop(ticket, None)

    def close(self) -> None:
        """Withdraw the client; idempotent. On return it is gone, unless the take loop called."""
        self._withdraw(self)

    def drain(self) -> None:
        """Deliver received messages. Take loop only."""
        for _ in range(BURST):
            try:
                taken = self.take()
            except RosError as error:
                self._counters.warn(
                    log, "unreadable", "%s: %s", self._client.srv_name, error.message
                )
                return
            if taken is None:
                return
            ticket, payload = taken
            with self._lock:
                on_response = self._pending.pop(ticket, None)
            if on_response is None:
                continue
            try:
                on_response(payload)
            except Exception:
                log.exception("%s: a response was lost", self._client.srv_name)

    def destroy(self, node: Any) -> None:
        """Free all resources. Take loop only, once, when no wait set holds the handle."""
        with self._lock:
            end, self._end = self._end, None
            self._pending.clear()
        if end is not None:
            end.close()
            node.destroy_client(self._client)
