"""The wire in memory: the same contract with no threads and no clock, moved by hand.

For tests and simulations. Nothing happens but in `pump` (deliver what is under way) and
`advance` (let time pass): so a test decides what arrives when, and two runs are alike.

Owns: links, listeners and messages of one pretended network.
Not here: certificates; a listener's name stands for its certificate.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

from fogft.errors import WireError
from fogft.link.port import Answer, Incoming, LinkEvents, Peer, Probe, ProbeAnswer, SendOptions
from fogft.model.refusal import Refusal
from fogft.model.replica import ReplicaId
from fogft.records.record import Record, SignedRecord
from tests.fakes.link_ends import MemoryIncoming, MemoryLink, Session

_STEP_S = 0.05


class MemoryWire:
    """A pretended network: who listens where, and what is under way."""

    def __init__(self) -> None:
        self.now = 0.0
        self._listeners: dict[str, MemoryListener] = {}
        self.links: list[MemoryLink] = []
        self._mail: deque[_Mail] = deque()
        self._ports = iter(range(40000, 65536))

    def listener(self, id: ReplicaId, endpoint: str = "") -> MemoryListener:
        """Make a replica's end; it is reached once it serves."""
        return MemoryListener(self, id, endpoint or f"memory:{next(self._ports)}")

    def dialer(
        self,
        robot: str = "robot",
        *,
        suspect_after_s: float = 2.0,
    ) -> MemoryDialer:
        """Make a robot's end."""
        return MemoryDialer(self, robot, suspect_after_s)

    # -- moved by hand --------------------------------------------------------------------

    def pump(self) -> int:
        """Deliver all that is under way and can arrive, in order; return how much that was."""
        delivered = 0
        held: deque[_Mail] = deque()
        while self._mail:
            mail = self._mail.popleft()
            if mail.session.ended:
                continue
            if mail.session.listener.frozen:
                held.append(mail)
                continue
            delivered += 1
            mail.deliver()
        self._mail = held
        return delivered

    def advance(self, seconds: float) -> None:
        """Let time pass in small steps: links connect, probe, suspect; attempts time out."""
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.now = min(end, self.now + _STEP_S)
            for link in list(self.links):
                link.tick()
            self.pump()

    def freeze(self, endpoint: str) -> None:
        """Stop a listener as SIGSTOP would: it hears and says nothing; what is sent waits."""
        self._listeners[endpoint].frozen = True

    def thaw(self, endpoint: str) -> None:
        """Let a frozen listener go on."""
        self._listeners[endpoint].frozen = False

    def kill(self, endpoint: str) -> None:
        """End a listener as SIGKILL would: every link to it notices at once."""
        self._listeners[endpoint].close()

    # -- of its parts ---------------------------------------------------------------------

    def bind(self, listener: MemoryListener) -> None:
        """Make a listener reachable."""
        if listener.endpoint in self._listeners:
            raise WireError(f"cannot listen at `{listener.endpoint}`: it is taken")
        self._listeners[listener.endpoint] = listener

    def unbind(self, listener: MemoryListener) -> None:
        """End a listener; every link to it notices."""
        if self._listeners.get(listener.endpoint) is listener:
            del self._listeners[listener.endpoint]
            for link in list(self.links):
                link.lost(listener)

    def at(self, endpoint: str) -> MemoryListener | None:
        """Return who listens at an endpoint."""
        return self._listeners.get(endpoint)

    def post(self, session: Session, deliver: Callable[[], None]) -> None:
        """Send a message of a session on its way."""
        self._mail.append(_Mail(session, deliver))


@dataclass(frozen=True)
class _Mail:
    session: Session
    deliver: Callable[[], None]


class MemoryDialer:
    """Makes links in memory; see `port.Dialer`."""

    def __init__(
        self,
        wire: MemoryWire,
        robot: str,
        suspect_after_s: float,
    ) -> None:
        self.wire = wire
        self.robot = robot
        self.suspect_after_s = suspect_after_s
        self._links: list[MemoryLink] = []

    def dial(self, peer: Peer, services: Mapping[str, str], events: LinkEvents) -> MemoryLink:
        """Make a link, in state CONNECTING."""
        link = MemoryLink(self, peer, services, events)
        self._links.append(link)
        self.wire.links.append(link)
        return link

    def adopt(self, options: SendOptions) -> None:
        """Do nothing: this wire has no queue."""

    def renew(self) -> None:
        """Do nothing: this wire has no certificates."""

    def tell(self, records: Sequence[SignedRecord]) -> None:
        """Do nothing: this wire has no certificates to take back."""

    def newer(self) -> list[SignedRecord]:
        """Return nothing: this wire tells nobody anything."""
        return []

    def certificate(self) -> str:
        """Return nothing: this wire has no certificates."""
        return ""

    def close(self) -> None:
        """Close every link."""
        for link in self._links:
            link.close()


class MemoryListener:
    """A replica's end in memory; see `ZenohListener`."""

    def __init__(self, wire: MemoryWire, id: ReplicaId, endpoint: str) -> None:
        self._wire = wire
        self._endpoint = endpoint
        self._services: dict[str, str] = {}  # key -> name
        self._on_request: Callable[[Incoming], None] | None = None
        self._on_probe: Callable[[Probe], ProbeAnswer] | None = None
        self._on_cancel: Callable[[Sequence[bytes]], None] = lambda ids: None
        self.certificate_name = id.certificate_name
        self.frozen = False
        self.count: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()

    @property
    def endpoint(self) -> str:
        """Where it listens."""
        return self._endpoint

    def serve(
        self,
        services: Mapping[str, str],
        on_request: Callable[[Incoming], None],
        on_probe: Callable[[Probe], ProbeAnswer],
        on_cancel: Callable[[Sequence[bytes]], None] = lambda ids: None,
    ) -> None:
        """Begin to listen.

        Raises:
            WireError: Another listener has this endpoint.
        """
        self._wire.bind(self)
        self._services = {key: name for name, key in services.items()}
        self._on_request, self._on_probe, self._on_cancel = on_request, on_probe, on_cancel

    def add(self, services: Mapping[str, str]) -> None:
        """Hear requests for further services too (name -> key)."""
        self._services |= {key: name for name, key in services.items()}

    def request(self, key: str, incoming: MemoryIncoming) -> None:
        """Take a request that arrived."""
        name = self._services.get(key)
        if name is None or self._on_request is None:
            incoming.answer(Answer(incoming.request_id, refusal=Refusal.LOST), "unknown")
            return
        self.count["requests"] += 1
        incoming.service = name
        self._on_request(incoming)

    def probe(self, probe: Probe) -> ProbeAnswer | None:
        """Answer a probe that arrived; None where nobody serves."""
        self.count["probes"] += 1
        return self._on_probe(probe) if self._on_probe is not None else None

    def revoke(self, names: Collection[str]) -> None:
        """Do nothing: this wire has no certificates."""

    def lease(self) -> Record | None:
        """Return nothing: this wire carries no records."""
        return None

    def cancel(self, ids: Sequence[bytes]) -> None:
        """Take a cancellation that arrived."""
        self.count["cancellations"] += 1
        self._on_cancel(ids)

    def counters(self) -> Mapping[str, int]:
        """Counts by event name."""
        return dict(self.count)

    def refusals(self) -> Mapping[str, int]:
        """Refusals by value."""
        return dict(self.refused)

    def close(self) -> None:
        """Stop; every link notices at once. Repeatable."""
        self._wire.unbind(self)
        self._on_request = self._on_probe = None
