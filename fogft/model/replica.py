"""Values used everywhere: replica, placement, machine, link report.

Pure data, immutable, compared by value. docs/reference/glossary.md defines the terms.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Annotated

from fogft.model.credentials import Holder, Role
from fogft.model.keys import only
from fogft.model.names import EndpointOrEmpty, PoolUid
from fogft.model.plain import Count
from fogft.model.reason import Reason
from fogft.model.topology import Topology

_VERSION = re.compile(r"[\w.-]{0,64}", re.ASCII)


@dataclass(frozen=True, order=True)
class ReplicaId:
    """One launch of one slot of one pool. Never used twice."""

    pool_uid: PoolUid
    slot: Count  # outlives the machines that fill it
    generation: Count  # counts the launches of a slot from 1; a higher one fences off the lower

    @property
    def short(self) -> str:
        """Slot and generation, as shown to people: ``2.1``."""
        return f"{self.slot}.{self.generation}"

    @cached_property
    def key(self) -> int:
        """Slot and generation in one number, which identifies a replica within its pool."""
        return self.slot << 32 | self.generation

    @property
    def certificate_name(self) -> str:
        """The common name of its certificate."""
        return Holder(Role.REPLICA, str(self.slot), self.generation, self.pool_uid).common_name

    def __str__(self) -> str:
        return f"{self.pool_uid}-{self.slot}.{self.generation}"

    def __hash__(self) -> int:
        return self.slot << 32 ^ self.generation  # nearly all are of one pool


def short(key: int) -> str:
    """Return slot and generation of a `ReplicaId.key`, as shown to people."""
    return f"{key >> 32}.{key & 0xFFFFFFFF}"


@dataclass(frozen=True, order=True)
class Placement:
    """A location and an instance type: what an offer sells and a launch requests."""

    cloud: str
    region: str
    zone: str
    instance: str
    spot: bool = True

    @cached_property
    def location(self) -> str:
        """``cloud/region/zone``: the unit that can be excluded, full or in backoff."""
        return f"{self.cloud}/{self.region}/{self.zone}"

    @cached_property
    def supply(self) -> str:
        """The unit that can run out of capacity: a location's spot or on-demand machines."""
        return supply(self.location, on_demand=not self.spot)

    @cached_property
    def domains(self) -> tuple[str, str, str]:
        """Its failure domains, the widest first: cloud, region, location."""
        return self.cloud, f"{self.cloud}/{self.region}", self.location

    def within(self, location: str) -> bool:
        """Whether this lies in a location given as ``cloud``, ``cloud/region`` or all three."""
        return (self.location + "/").startswith(location.rstrip("/") + "/")


def supply(location: str, *, on_demand: bool) -> str:
    """Return `Placement.supply` of a location: the location itself for spot machines."""
    return f"{location} on demand" if on_demand else location


@dataclass(frozen=True)
class Offer:
    """A placement with its price in US dollars per hour."""

    placement: Placement
    usd_per_hour: float
    source: str = ""  # of the price: ``live``, ``catalogue``; empty if it is simulated
    as_of: float = 0.0  # when the price was valid, in seconds since the epoch; 0 if unknown
    group: str = ""  # the pool file's group that it suits; empty without groups
    extras_usd_per_hour: float = 0.0  # the part for its disk and its address
    egress_usd_per_hour: float = 0.0  # the part for responses that leave the cloud


class Phase(str, Enum):
    """The phases of a replica's life. A replica only moves forward."""

    PROVISIONING = "provisioning"  # requested from the cloud, not yet running
    STARTING = "starting"  # the machine runs; the service does not answer yet
    READY = "ready"  # the service answers
    DRAINING = "draining"  # answers, but will end: gets no new requests while others can answer
    GONE = "gone"


class MachinePhase(str, Enum):
    """A machine's phase as reported by its cloud. Absence from the list means gone."""

    PROVISIONING = "provisioning"
    RUNNING = "running"
    STOPPED = "stopped"  # it costs its disk, and can be started
    FAILED = "failed"  # a launch that will never run; stays listed until terminated


@dataclass(frozen=True)
class Machine:
    """One of fogft's machines in a cloud's list. Times are seconds since the epoch; 0: unknown.

    `notice`: a preemption notice, if the list has it; otherwise see its link (`LinkReport`).
    """

    id: ReplicaId
    placement: Placement
    phase: MachinePhase
    launched_at: float
    endpoint: str | None = None  # ``host:port`` where the server proxy listens, once known
    notice: bool = False
    usd_per_hour: float = 0.0
    spec_hash: str = ""  # `PoolSpec.replica_hash` at launch; outdated if the pool's differs
    failure: Reason | None = None  # its words may end in a line break and a log's last lines
    progress: str = ""  # what the cloud reports it is doing before it serves, for people
    setting_up: bool = False
    running_at: float = 0.0  # when it was seen running
    set_up_at: float = 0.0
    pool: str = ""  # its name, if the cloud knows it


def by_id(machine: Machine) -> tuple[str, int, int]:
    """Return the sort key of machines. Plain values compare faster than ids."""
    id = machine.id
    return id.pool_uid, id.slot, id.generation


class LinkState(str, Enum):
    """The state of a client proxy's link to a replica."""

    CONNECTING = "connecting"  # has not answered a probe yet
    UP = "up"  # the last probe was answered in time
    SUSPECT = "suspect"  # was up; the server proxy no longer answers probes


DOUBTED_AFTER_S = 0.6
"""A probe unanswered for this long is a reason to ask the cloud, and nothing more."""
_DOUBTED_AFTER_ROUND_TRIPS = 3


def doubted_after_s(rtt_s: float | None) -> float:
    """Return the number of seconds without a probe reply after which a replica is in doubt."""
    return max(DOUBTED_AFTER_S, _DOUBTED_AFTER_ROUND_TRIPS * (rtt_s or 0.0))


@dataclass(frozen=True)
class LinkReport:
    """The client proxy's report of one replica. Ages and durations in seconds."""

    id: ReplicaId
    state: LinkState
    ready: frozenset[str] = frozenset()  # services that it reports it can answer now
    leaving: bool = False  # it reports that its machine will be taken
    draining: bool = False  # leaving, or marked to end: no new requests while others can answer
    at_risk: bool = False  # its cloud recommends moving it; it keeps serving meanwhile
    disagrees: bool = False  # repeatedly, with the quorum; or one of the next two
    misread: bool = False  # its answers could not be read as responses
    ignores: bool = False  # it never completes requests that others answer
    heard_age_s: float | None = None  # since it last answered a probe; None if never
    silent_for_s: float = 0.0  # how long probes have gone unanswered; 0 while they are answered
    rtt_s: float | None = None
    in_flight: int = 0
    won: int = 0
    restarts: int = 0
    strangers: int = 0  # connections to its port by peers without a certificate
    version: str = ""  # of fogft on the replica; empty if unknown
    lease_left_s: float | None = None  # until it shuts down unless it hears from it; None: never
    answered: int = 0  # requests that it answered successfully, first or not
    failed: int = 0  # requests that ended in a crash, a refusal or a response that was not ok
    detail: str = ""  # last error in words (connection refused, wrong certificate, ...)
    differs: bool = False  # a service's type differs from the robot's, or cannot be loaded
    differing: tuple[str, ...] = ()
    offered: tuple[tuple[str, str], ...] = ()  # by `run`: name and type, if discovered or wrong

    @property
    def doubted(self) -> bool:
        """Whether it was up and is silent for longer than answers take, so the cloud is asked."""
        if self.state is LinkState.UP:
            return self.silent_for_s >= doubted_after_s(self.rtt_s)
        return self.state is LinkState.SUSPECT


@dataclass(frozen=True)
class Observed:
    """All inputs of a plan besides the spec: the pool as observed at `now`."""

    now: float
    machines: tuple[Machine, ...] | None  # the cloud's own list; None if it did not answer
    links: tuple[LinkReport, ...] | None = None  # None when there is no fresh report
    offers: tuple[Offer, ...] = ()
    ending: frozenset[ReplicaId] = frozenset()  # already told to end, perhaps still listed
    rtt_s: Mapping[str, float] = field(default_factory=dict)  # from the robot, by ``cloud/region``
    doubt_s: float = 0.0  # how far the clock was just set; `wall_clock` leaves that out
    gateway: tuple[Machine, ...] = ()  # the launched one; several while it is replaced
    standbys: tuple[Machine, ...] = ()  # machines that are stopped
    certificates_due: frozenset[ReplicaId] = frozenset()  # whose certificates expire soon

    @property
    def wall_clock(self) -> float:
        """The time for schedule windows: a clock that was set is trusted only after a while."""
        return self.now - self.doubt_s

    def below(self, cap: float | None) -> float | None:
        """Return what a cap leaves for replicas, after the gateway and the standbys."""
        if cap is None:
            return None
        return max(0.0, cap - sum(m.usd_per_hour for m in (*self.gateway, *self.standbys)))


@dataclass(frozen=True)
class Member:
    """A replica that the client proxy should hold a link to, or a gateway in place of replicas."""

    id: ReplicaId
    endpoint: EndpointOrEmpty  # empty if not known yet, or if the replica dials out
    draining: bool = False
    gateway: str = ""  # its name; empty for a replica
    version: Annotated[str, only(_VERSION.fullmatch)] = ""  # `Machine.spec_hash`, if known

    @property
    def certificate_name(self) -> str:
        """The common name that its certificate must have."""
        if self.gateway:
            id = self.id
            return Holder(Role.GATEWAY, self.gateway, id.generation, id.pool_uid).common_name
        return self.id.certificate_name


@dataclass(frozen=True)
class Membership:
    """The members of a pool and their endpoints; written by the manager, read by proxies.

    A lower (epoch, version) never replaces a higher one.
    """

    pool: str
    pool_uid: PoolUid
    epoch: Count  # of the writing manager's lease
    version: Count  # counts its writes
    members: tuple[Member, ...] = ()
    revoked: frozenset[str] = frozenset()  # common names of certificates; only ever grows
    topology: Topology = field(default_factory=Topology)
