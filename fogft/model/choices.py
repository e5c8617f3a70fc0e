"""What a pool file may say about where, how many, when and at what price. Values only.

Reading and judging is `spec_plan`'s; what follows from them is `sizing`'s, `schedule`'s,
`score`'s and `migration`'s.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from fogft.model.scoring import Weights
from fogft.planning.availability import Assumption


class Freshness(str, Enum):
    """Which of a service's requests goes first where several wait."""

    EVERY = "every"  # the one that came first, or whose deadline is nearest
    LATEST = "latest"  # the newest: of a camera's images the older ones are worth less


class Compression(str, Enum):
    """Whether a service's payloads are compressed on thin links."""

    AUTO = "auto"  # where it pays, as measured
    OFF = "off"


@dataclass(frozen=True)
class AvailabilitySpec:
    """How available the pool shall be, and what is assumed of machines.

    Attributes:
        target: Fraction of time that a replica shall answer, in (0, 1).
    """

    target: float
    assumed: Assumption = field(default_factory=Assumption)


@dataclass(frozen=True)
class MetricsSpec:
    """Where processes listen for Prometheus: ``host:port``; empty for nowhere.

    Attributes:
        proxy: The client proxy of the robot that ran `fogft up`.
        manager: The manager.
        replica: The server proxies; replica SLOT has the port plus SLOT.
    """

    proxy: str = ""
    manager: str = ""
    replica: str = ""

    def of_replica(self, slot: int) -> str:
        """Return the endpoint of a slot's replica."""
        host, _, port = self.replica.rpartition(":")
        return f"{host}:{int(port) + slot}" if host else ""


@dataclass(frozen=True)
class OnDemandSpec:
    """How spot and on-demand machines are mixed.

    Attributes:
        base: Replicas that are always on demand.
        fallback: Whether on-demand machines stand in while no spot machine can be had.
    """

    base: int = 0
    fallback: bool = False


@dataclass(frozen=True)
class GroupSpec:
    """Replicas of one pool that have machines of their own kind.

    Attributes:
        resources: As under `resources`, whole: the file's own with the group's on top.
    """

    name: str
    replicas: int
    resources: Mapping[str, Any] = field(default_factory=dict)
    on_demand: OnDemandSpec = field(default_factory=OnDemandSpec)


@dataclass(frozen=True)
class WindowSpec:
    """A time of the week, in the schedule's time zone.

    Attributes:
        days: 0 for Monday to 6 for Sunday: on which it begins.
        begins_s: Seconds after midnight by the clock on the wall, in [0, 86400).
        ends_s: Likewise, in (0, 86400]; not after `begins_s` means the next day.
        replicas: How many are wanted within it; None for the pool's own number.
        max_usd_per_hour: The cap within it; None for the pool's own.
    """

    days: frozenset[int]
    begins_s: int
    ends_s: int
    replicas: int | None = None
    max_usd_per_hour: float | None = None


@dataclass(frozen=True)
class ScheduleSpec:
    """Replicas and cap by the time of the week.

    Attributes:
        time_zone: A name of the IANA database, or ``UTC``.
        windows: The first that holds a moment decides it.
        prelaunch_s: So long before a window its replicas are launched.
    """

    time_zone: str
    windows: tuple[WindowSpec, ...]
    prelaunch_s: float = 600.0


@dataclass(frozen=True)
class MigrationSpec:
    """When a replica moves to a better location.

    Attributes:
        gain: How much lower the score must be there, as a fraction in (0, 1).
        stay_s: How long a replica stays, from ready on, before it may move.
    """

    gain: float = 0.3
    stay_s: float = 3600.0


@dataclass(frozen=True)
class PlacementSpec:
    """How locations are weighed, and what is known of distances.

    Attributes:
        robot_at: Latitude and longitude in degrees, for estimates; None for unknown.
        rtt_s: ``cloud/region`` or ``cloud`` -> round trip in seconds; goes before measurements.
    """

    weights: Weights = field(default_factory=Weights)
    robot_at: tuple[float, float] | None = None
    rtt_s: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class TrafficSpec:
    """What is asked of one service, for costs. Zero where it is not said."""

    requests_per_s: float = 0.0
    request_bytes: float = 0.0
    response_bytes: float = 0.0


@dataclass(frozen=True)
class FallbackSpec:
    """The service on the robot that answers when the replicas do not.

    Attributes:
        service: Its name; of the same type.
        after_s: Ask it so long after the request came, beside the replicas; None for not
            before the deadline.
        while_none_ready: Ask it at once while no replica is ready.
        limit_s: How long its answer is awaited past the deadline.
    """

    service: str
    after_s: float | None = None
    while_none_ready: bool = False
    limit_s: float = 1.0
