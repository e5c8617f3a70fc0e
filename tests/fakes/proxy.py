"""Hand-driven ends of the ports, for tests of the proxies: nothing happens by itself."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from fogft.errors import RosError
from fogft.link.port import Answer, LinkStatus, Peer, Probe, ProbeAnswer
from fogft.model.plain import to_plain
from fogft.model.refusal import Refusal
from fogft.model.replica import LinkState, ReplicaId
from fogft.records.record import Record, RecordKind
from fogft.records.roster import ServingLease
from fogft.requests.load import Handling, Load

UID = "0123456789abcdef"


class Clock:
    """Time that moves only when told."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class FakeLink:
    """A link whose answers the test gives."""

    def __init__(self, slot: int, *, generation: int = 1, room: int = 1000) -> None:
        self.peer = Peer(ReplicaId(UID, slot, generation), f"h{slot}:1", f"replica.{slot}")
        self.ready: frozenset[str] = frozenset()
        self.leaving = self.thin = False
        self.room = room
        self.offered: list[tuple[str, bytes, bytes, float]] = []
        self.handled: list[Handling] = []
        self.waits = 0  # offers that wait for more
        self.forgotten: list[bytes] = []
        self.closed = False
        self.told: ProbeAnswer | None = None

    @property
    def usable(self) -> bool:
        return bool(self.ready)

    def offer(
        self,
        service: str,
        request_id: bytes,
        payload: bytes,
        remaining_s: float,
        *,
        more: bool = False,
        handling: Handling = Handling.NORMAL,
    ) -> bool:
        if len(self.offered) >= self.room:
            return False
        self.offered.append((service, request_id, payload, remaining_s))
        self.handled.append(handling)
        self.waits += more
        return True

    def send(self) -> None:
        self.waits = 0

    def forget(self, request_id: bytes) -> None:
        self.forgotten.append(request_id)

    def flush(self) -> None:
        pass

    def status(self) -> LinkStatus:
        state = LinkState.UP if self.ready else LinkState.SUSPECT
        return LinkStatus(state, self.told, 0.0, 0.0, 0.001, 0, 0, "")

    def close(self) -> None:
        self.closed = True

    def reply(self, payload: bytes, n: int = -1) -> Answer:
        service, request, _, _ = self.offered[n]
        return Answer(request, payload=payload, service=service)

    def refusal(self, reason: str, n: int = -1) -> Answer:
        service, request, _, _ = self.offered[n]
        return Answer(request, refusal=Refusal(reason), service=service)


class FakeDialer:
    """Makes `FakeLink`s and keeps them, newest last."""

    def __init__(self) -> None:
        self.renewals, self.name = 0, ""
        self.links: list[FakeLink] = []

    def dial(self, peer, services, events) -> FakeLink:
        link = FakeLink(peer.id.slot, generation=peer.id.generation)
        link.peer = peer
        link.events = events  # type: ignore[attr-defined]
        link.services = dict(services)  # type: ignore[attr-defined]
        self.links.append(link)
        return link

    def adopt(self, options) -> None:
        self.options = options

    def renew(self) -> None:
        self.renewals += 1

    def certificate(self) -> str:
        return self.name

    def tell(self, records) -> None:
        self.told = list(records)

    def newer(self):
        return []

    def close(self) -> None:
        for link in self.links:
            link.close()


class FakeIncoming:
    """A request at the replica; keeps what it was answered."""

    def __init__(
        self,
        request_id: bytes,
        payload: bytes = b"q",
        *,
        service: str = "/s",
        remaining_s=10.0,
        robot: str = "r",
        handling: Handling = Handling.NORMAL,
    ) -> None:
        self.handling = handling
        self.load: Load | None = None
        self.request_id = request_id
        self.payload = payload
        self.service = service
        self.robot = robot
        self.remaining_s = remaining_s
        self.outcome: list[Any] = []

    def reply(self, payload: bytes, *, load: Load | None = None, more: bool = False) -> None:
        self.outcome.append(payload)
        self.load, self.more = load, more

    def refuse(self, reason: Refusal, detail: str = "", *, load: Load | None = None) -> None:
        self.outcome.append(f"refused {reason}")
        self.load = load


class FakeClient:
    """A client of a local service; the test answers."""

    def __init__(self) -> None:
        self.there = self.known = True
        self.stranger = ""
        self.count = 1
        self.broken: RosError | None = None
        self.calls: list[tuple[bytes, Callable[[bytes], None]]] = []
        self.forgotten: list[int] = []
        self.closed = False

    def is_known(self) -> bool:
        return self.known

    def available(self) -> bool:
        return self.there

    def servers(self) -> int:
        return self.count if self.there else 0

    def mismatch(self) -> str:
        return self.stranger

    def call(self, payload: bytes, on_response: Callable[[bytes], None]) -> int:
        if self.broken is not None:
            raise self.broken
        self.calls.append((payload, on_response))
        return len(self.calls)

    def forget(self, ticket: int) -> None:
        self.forgotten.append(ticket)

    def close(self) -> None:
        self.closed = True


class FakeServer:
    """A service offered to the robot."""

    def __init__(self, on_request) -> None:
        self.on_request = on_request
        self.responses: list[tuple[Any, bytes]] = []
        self.closed = False
        self.stranger = ""

    def mismatch(self) -> str:
        return self.stranger

    def respond(self, handle: Any, payload: bytes) -> None:
        self.responses.append((handle, payload))

    def close(self) -> None:
        self.closed = True


class FakeNode:
    """A ROS node without ROS."""

    def __init__(self) -> None:
        self.servers: dict[str, FakeServer] = {}
        self.clients: dict[str, FakeClient] = {}
        self.closed = False
        self.alive = True
        self.refuses = ""
        self.graph: dict[str, str] = {}

    def serve(self, name, type_name, on_request, on_burst=None) -> FakeServer:
        if self.refuses == name:
            raise RosError("its type cannot be loaded")
        self.servers[name] = FakeServer(on_request)
        return self.servers[name]

    def client(self, name, type_name) -> FakeClient:
        if self.refuses == name:
            raise RosError("its type cannot be loaded")
        self.clients[name] = FakeClient()
        return self.clients[name]

    def look(self) -> None:
        """Nothing here depends on a clock."""

    def offered(self) -> dict[str, str]:
        return dict(self.graph)

    def close(self) -> None:
        self.closed = True


def lease(number: int, *, at: float, lasts_s: float, epoch: int = 1) -> Record:
    """Return the lease of that number in the manager's epoch, its signature checked."""
    content = to_plain(ServingLease(at, lasts_s))
    return Record("0123456789abcdef", RecordKind.LEASE, "", epoch, number, content)


class FakeListener:
    """A listener whose requests and probes the test makes."""

    endpoint = "127.0.0.1:7447"

    def __init__(self) -> None:
        self.closed = False
        self.signed: Record | None = None
        self.services: dict[str, str] = {}

    def lease(self) -> Any:
        found = self.signed
        return None if found is None else SimpleNamespace(record=found)

    def serve(self, services, on_request, on_probe, on_cancel) -> None:
        self.on_cancel = on_cancel
        self.services = dict(services)
        self.on_request = on_request
        self.on_probe: Callable[[Probe], ProbeAnswer] = on_probe

    def add(self, services) -> None:
        self.services |= services

    def revoke(self, names) -> None:
        pass

    def counters(self):
        return {}

    def refusals(self):
        return {}

    def close(self) -> None:
        self.closed = True


class FakeSupervisor:
    """A command that lives and dies as the test says."""

    def __init__(self, domain_id: int | None = None) -> None:
        self.domain_id = domain_id
        self.alive = False
        self.restarts = -1
        self.last_exit = ""
        self.dies = False
        self.stopped = False

    def poll(self, *, at_work: bool = False) -> bool:
        died, self.dies = self.dies, False
        if died or not self.alive:
            self.restarts += 1
        self.alive = True
        return died

    def restart(self) -> None:
        self.dies = True

    def stop(self) -> None:
        self.alive = False
        self.stopped = True
