"""The interface between proxies: a robot's links on one side, a replica's listener on the other.

Law of this port: `Link.offer` never blocks, whatever the peer does; a slow or dead peer
affects only its own link. Callbacks run on the transport's threads; they must not block.
Implementations: `fogft.link.zenoh.robot.link` and `uplinks`, `tests.fakes.link`. A replica's end is
`fogft.link.zenoh.replica.listener`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Protocol

from fogft.model.choices import Compression, Freshness
from fogft.model.plain import Count, Line, Seconds
from fogft.model.refusal import Refusal
from fogft.model.replica import LinkState, ReplicaId
from fogft.model.spec import ServiceSpec
from fogft.model.type_definition import Definition
from fogft.records.record import SignedRecord
from fogft.requests.load import Handling, Load


@dataclass(frozen=True)
class SendOptions:
    """Services that want the newest request first, no compression, or deadlines on the link."""

    latest: frozenset[str] = frozenset()
    plain: frozenset[str] = frozenset()
    # For other services, such as topics and the orders of a stateful service, the time of a
    # request is not a deadline: it only says when to resend it.
    timed: frozenset[str] = frozenset()

    @classmethod
    def of(cls, services: Collection[ServiceSpec]) -> SendOptions:
        """Return the options of these services."""
        return cls(
            frozenset(s.name for s in services if s.freshness is Freshness.LATEST),
            frozenset(s.name for s in services if s.compression is Compression.OFF),
            frozenset(s.name for s in services if s.state is None),
        )


@dataclass(frozen=True)
class Probe:
    """The content of a robot's probe."""

    robot: Line
    describe: bool = False  # the answer should include the definitions of the services' types
    version: Line = ""  # of fogft on the robot; empty before 0.2.0


@dataclass(frozen=True, kw_only=True)
class ReplicaWord:
    """A replica's own state, as reported in probe answers and by gateways.

    Durations and counts that change all the time are ignored when two reports are compared.
    """

    slot: Count
    generation: Count
    ready: frozenset[Line] = frozenset()  # names of the services that it can answer now
    draining: bool = False  # the replica is leaving: its machine got a preemption notice
    at_risk: bool = False  # its cloud recommends moving it; it continues to serve
    restarts: Count = 0  # of the user's `run` command
    detail: Line = ""  # why it is not ready, in words; empty if it is ready
    version: Line = ""  # of fogft on the replica; empty before 0.2.0
    # Time since the manager last renewed its lease, and until it shuts down without a renewal.
    lease_age_s: Seconds | None = field(default=None, compare=False)
    lease_left_s: Seconds | None = field(default=None, compare=False)


@dataclass(frozen=True, kw_only=True)
class GatewayView(ReplicaWord):
    """A gateway's link to one replica behind it. Durations in seconds."""

    state: LinkState
    silent_for_s: Seconds = field(default=0.0, compare=False)
    rtt_s: Seconds | None = field(default=None, compare=False)
    through: Line = ""  # further gateways on the path: ``lab`` or ``lab/edge``; empty for none

    @classmethod
    def of(cls, report: Mapping[str, Any]) -> GatewayView:
        """Build a view from a client proxy's report of a link."""
        known = {field.name: report[field.name] for field in fields(cls) if field.name in report}
        known |= {"state": LinkState(report["state"]), "ready": frozenset(report["ready"])}
        known["draining"] = report["leaving"]
        return cls(**known)


@dataclass(frozen=True, kw_only=True)
class ProbeAnswer(ReplicaWord):
    """A replica's answer to a probe."""

    # Random text generated when the server proxy started. A new value at the same id means that it
    # has restarted, and forgotten every request.
    incarnation: Line
    in_flight: Count = field(default=0, compare=False)
    work: Mapping[Line, Seconds] = field(default_factory=dict, compare=False)  # since its start
    # Service name -> type that `run` offers, if none is configured or it differs from that one.
    offered: Mapping[Line, Line] = field(default_factory=dict)
    types: Mapping[Line, Definition] = field(default_factory=dict)  # by name, if the probe asks
    behind: tuple[GatewayView, ...] = ()
    accepts: frozenset[Line] = frozenset()  # the compressions it supports; since 0.2.0, all
    # Services that have requests and have answered none for far longer than they usually take.
    hanging: frozenset[Line] = frozenset()
    # Connections rejected because the peer did not authenticate.
    strangers: Count = field(default=0, compare=False)


@dataclass(slots=True)  # one per answer: a frozen one costs three times as much
class Answer:
    """The outcome of one attempt: `payload` if the service answered, else a `refusal`."""

    request_id: bytes
    payload: bytes | None = None
    refusal: Refusal | None = None
    service: str = ""  # the name given to `Link.offer`
    detail: str = ""  # of the refusal, if its kind has one
    load: Load | None = None


class LinkEvents(Protocol):
    """Callbacks from a link to its owner. Called from the link's threads; must not block."""

    def answered(self, link: Link, answer: Answer) -> None:
        """An attempt has ended. Called exactly once for each accepted `offer`.

        If its link dies it ends with ``Refusal.LOST``, and the link drops later answers to it.
        """

    def late(self, link: Link, answer: Answer) -> None:
        """A forgotten attempt has ended. May not be called if its connection was given up."""

    def changed(self, link: Link) -> None:
        """The link's `state`, `probe_answer` or room in its window has changed."""


@dataclass(frozen=True)
class Peer:
    """A replica to dial: its endpoint (``host:port``) and the name its certificate must have.

    `interface` is the local network interface to use; empty to follow the routing table.
    """

    id: ReplicaId
    endpoint: str
    certificate_name: str
    interface: str = ""


@dataclass(frozen=True)
class LinkStatus:
    """A snapshot of a link. Durations in seconds."""

    state: LinkState
    probe_answer: ProbeAnswer | None
    heard_age_s: float | None
    silent_for_s: float
    rtt_s: float | None
    in_flight: int
    reopened: int
    detail: str
    uplinks: tuple[Mapping[str, Any], ...] = ()  # the status of each, if there are several
    ignores: bool = False  # it takes requests and never ends them, though other replicas do


class Link(Protocol):
    """A robot's connection to one replica: its own session, sender thread and bounded window."""

    peer: Peer  # the replica at the other end

    @property
    def usable(self) -> bool:
        """Whether requests may be offered: state UP. Cheap, called for each request."""

    @property
    def ready(self) -> frozenset[str]:
        """Services that the last probe answer reported ready; empty unless UP. Cheap."""

    @property
    def leaving(self) -> bool:
        """Whether the replica reported that its machine is being preempted. Cheap."""

    @property
    def thin(self) -> bool:
        """Whether its network path was measured to be slow. Cheap."""

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
        """Accept one attempt, or return False if the window is full or the link not usable.

        Never blocks. `service` is the name in the pool; its key was set by `services`. With `more`,
        other offers and then `send` must follow at once, so that they can share one message. Must
        not be called from a `LinkEvents` callback, because it may send.
        """

    def send(self) -> None:
        """Flush requests that were offered with `more`. Cheap; never blocks."""

    def forget(self, request_id: bytes) -> None:
        """Cancel a request whose answer is no longer wanted: free its window, tell the replica."""

    def flush(self) -> None:
        """Send cancellations for forgotten, unanswered requests. Cheap; never blocks."""

    def status(self) -> LinkStatus:
        """Return a snapshot, for people and for the manager."""

    def close(self) -> None:
        """End the link. Attempts still open end with `Refusal.LOST`. Repeatable, quick."""


class Dialer(Protocol):
    """Creates links. One for each client proxy."""

    def dial(self, peer: Peer, services: Mapping[str, str], events: LinkEvents) -> Link:
        """Start a link for these services (name -> key); return at once, in state CONNECTING."""

    def adopt(self, options: SendOptions) -> None:
        """Set the options of services, effective from the next connection."""

    def renew(self) -> None:
        """Reload the credentials from their files. No request is lost."""

    def tell(self, records: Sequence[SignedRecord]) -> None:
        """Send these records to every replica, now and whenever a link comes up."""

    def newer(self) -> list[SignedRecord]:
        """Return newer records that replicas sent in reply; nothing is verified."""

    def certificate(self) -> str:
        """Return the common name of the certificate that all links use; empty if they differ."""

    def close(self) -> None:
        """Close every link."""


class Incoming(Protocol):
    """A request at the replica. The first `reply` or `refuse` counts; later ones do nothing."""

    service: str
    request_id: bytes  # 16 bytes, generated by the client proxy
    robot: str  # the sender; replies to one robot never wait for another
    remaining_s: float  # time to its deadline when the robot sent it
    handling: Handling
    payload: bytes

    def reply(self, payload: bytes, *, load: Load | None = None, more: bool = False) -> None:
        """Send the serialised response, with the replica's load of this service.

        Never blocks. With `more`, other replies follow soon, so that they can share one message.
        """

    def refuse(self, reason: Refusal, detail: str = "", *, load: Load | None = None) -> None:
        """Send a refusal. Never blocks."""
