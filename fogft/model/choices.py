"""Pool file values: placement, numbers, schedule and price. Data only."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from fogft.errors import SpecError
from fogft.model.keys import (
    DAY_S,
    Flag,
    Free,
    Map,
    Maps,
    Number,
    OneOf,
    Special,
    Table,
    Text,
    Whole,
    key,
    only,
)
from fogft.model.names import endpoint
from fogft.model.ros_names import service_name

MAX_REPLICAS = 100
MAX_USD_PER_HOUR = 1_000_000
DAYS = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
_LOCATION = re.compile(r"[\w.-]+(/[\w.-]+)?")
_INTERFACE = re.compile(r"[A-Za-z0-9._-]{1,15}")
_CLOCK = re.compile(r"(\d{1,2}):(\d{2})")


class Freshness(str, Enum):
    """Which of a service's waiting requests is handled first."""

    EVERY = "every"  # the one that arrived first, or whose deadline is nearest
    LATEST = "latest"  # the newest: for example camera images, which lose value with age


class Spread(str, Enum):
    """How far spot replicas are spread when on-demand machines may fill in."""

    PREFER = "prefer"  # at most half of them in one location
    REQUIRE = "require"  # one in each


class Compression(str, Enum):
    """Whether a service's payloads are compressed on slow links."""

    AUTO = "auto"  # where measurements show that it pays
    OFF = "off"


class UplinkPolicy(str, Enum):
    """How a service's requests use several uplinks."""

    PREFER = "prefer"  # the first that is up, in the order listed
    FAILOVER = "failover"  # one until it fails, then the next; not back before that one fails
    ALL = "all"  # every one, at once


class Speaks(str, Enum):
    """How a proxy speaks ROS."""

    RCLPY = "rclpy"  # through the ROS 2 installed where it runs, with any middleware
    ZENOH = "zenoh"  # as the nodes of `rmw_zenoh` do, with no ROS installed


def is_interface(name: str) -> bool:
    """Whether this can be the name of a network interface on Linux."""
    return bool(_INTERFACE.fullmatch(name)) and name not in (".", "..")


@dataclass(frozen=True)
class Middleware:
    """How each side's proxy speaks ROS."""

    robot: Speaks = key(
        OneOf(Speaks),
        "How every robot's client proxy talks to the robot's nodes.",
        default=Speaks.RCLPY,
    )
    replica: Speaks = key(
        OneOf(Speaks),
        "How every replica's server proxy talks to what `run` starts; a change replaces replicas.",
        default=Speaks.RCLPY,
    )


@dataclass(frozen=True)
class Correlation:
    """Correlation of replica outages within a zone, a region and a cloud.

    Each is in [0, 1] and at most the one before. Those for a region and a cloud were measured
    (docs/design/availability.md). A zone without capacity takes back all of its machines, hence 1.
    """

    zone: float = 1.0
    region: float = 0.43
    cloud: float = 0.14


@dataclass(frozen=True)
class Assumption:
    """Assumptions about machines, for lack of measurements."""

    spot_uptime_s: float = key(
        Number(1e9, "seconds"),
        "Mean time until a ready spot machine is preempted; 15 h as in FogROS2-FT.",
        default=54_000.0,
    )
    on_demand_uptime_s: float = key(
        Number(1e9, "seconds"),
        "Mean time until a ready on-demand machine fails.",
        default=12_000_000.0,  # with 20 min of recovery, the 99.99 % that clouds promise
    )
    recovery_s: float = key(
        Number(DAY_S, "seconds"),
        "Time from the loss of a replica to a ready replacement; 20 min as in FogROS2-FT.",
        default=1200.0,
    )
    no_room: float = key(
        Number(1.0, from_zero=True),
        "Fraction of time that a location has no spot capacity; while no location has any, lost "
        "spot replicas cannot be replaced.",
        default=0.0625,
    )
    correlation: Correlation = field(default_factory=Correlation)


@dataclass(frozen=True)
class AvailabilitySpec(Assumption):
    """The pool's target availability, and assumptions about machines."""

    target: float = key(
        Number(0.99999),
        "Fraction of time that at least one replica answers.",
        kw_only=True,
    )


def _metrics(default_port: int) -> Text:
    hint = f"write an address that only your Prometheus reaches, such as `127.0.0.1:{default_port}`"
    return endpoint(hint)


@dataclass(frozen=True)
class MetricsSpec:
    """Addresses at which processes serve metrics: ``host:port``; empty for none."""

    proxy: str = key(
        _metrics(9464),
        "The client proxy of the robot that ran `fogft up`; other robots set theirs in "
        "`proxy.yaml`.",
        default="",
        usual="off",
    )
    manager: str = key(_metrics(9465), "The manager.", default="", usual="off")
    replica: str = key(
        _metrics(9466),
        "The server proxies: replica `SLOT` listens on this port plus `SLOT`. Applies to replicas "
        "launched after a change.",
        default="",
        usual="off",
    )

    def of_replica(self, slot: int) -> str:
        """Return the endpoint of a slot's replica."""
        host, _, port = self.replica.rpartition(":")
        return f"{host}:{int(port) + slot}" if host else ""


@dataclass(frozen=True)
class OnDemandSpec:
    """How spot and on-demand machines are mixed."""

    base: int = key(
        Whole(0, MAX_REPLICAS, "machines"),
        "Number of replicas that are always on demand; the rest are spot.",
        default=0,
    )
    fallback: bool = key(
        Flag(),
        "Use on-demand machines while too few spot machines are ready; fogft keeps looking for "
        "spot. Within `max_usd_per_hour` and `max_surge`.",
        default=False,
    )
    standbys: int = key(
        Whole(0, 10, "machines"),
        "With `fallback`: number of on-demand machines that are stopped rather than ended when "
        "spot is back, and started when it is lost again. Their disks cost. On real clouds only.",
        default=0,
    )


@dataclass(frozen=True)
class GroupSpec:
    """A group of replicas with their own kind of machine."""

    name: str = key(
        Text(
            "a group's name",
            "use lower-case letters, digits and dashes, at most 20, such as `anchor`",
            only(re.compile(r"[a-z][a-z0-9-]{0,19}").fullmatch),
        ),
        "Name of the group: lower-case letters, digits and dashes, at most 20.",
    )
    replicas: int = key(
        Whole(1, MAX_REPLICAS, "machines"),
        f"Number of replicas in the group; at most {MAX_REPLICAS} in all groups together.",
        default=1,
    )
    resources: Mapping[str, Any] = key(
        Free("write resources as at the top level"),
        "Override keys of the file's `resources`; a place replaces all of its places.",
        default_factory=dict,
    )
    on_demand: OnDemandSpec = key(
        Map(OnDemandSpec),
        "Like the pool's `on_demand`, for this group.",
        default_factory=OnDemandSpec,
    )


def _days(written: Any) -> frozenset[int]:
    parts = written if isinstance(written, list) else str(written).split(",")
    found: set[int] = set()
    for part in parts:
        first, _, last = str(part).strip().lower().partition("-")
        for name in (first, last or first):
            if name not in DAYS:
                raise SpecError(f"{name!r:.40} is not a day", "write `mon-fri` or `[sat, sun]`")
        begin, end = DAYS.index(first), DAYS.index(last or first)
        found |= {(begin + n) % 7 for n in range((end - begin) % 7 + 1)}
    return frozenset(found)


def _clock(written: Any) -> int:
    """Return a time of the day in seconds. YAML 1.1 reads 18:00 as the number 1080."""
    minutes = written if isinstance(written, int) and not isinstance(written, bool) else -1
    match = _CLOCK.fullmatch(written) if isinstance(written, str) else None
    if match and int(match[2]) < 60:
        minutes = int(match[1]) * 60 + int(match[2])
    if not 0 <= minutes <= 24 * 60:
        hint = "write hours and minutes: 8:30"
        if minutes > 0:  # YAML has read it as a number
            written = f"{minutes // 60}:{minutes % 60:02}"
        raise SpecError(f"`{written!s:.40}` is not a time of the day", hint)
    return minutes * 60


_CLOCK_FORM = Special("hours:minutes", _clock, {"type": ["string", "integer"]})
_DAYS_FORM = Special("days of the week", _days, {"type": ["string", "array"]})


@dataclass(frozen=True)
class WindowSpec:
    """A weekly time window in the schedule's time zone; None for the pool's own number or cap.

    Days count from 0 for Monday; times are seconds after midnight, local time.
    """

    days: frozenset[int] = key(
        _DAYS_FORM,
        "Days on which the window begins: `mon-fri`, `sat,sun` or `[mon, wed]`.",
        default=frozenset(range(7)),
        usual="every day",
    )
    begins_s: int = key(
        _CLOCK_FORM,
        "Start, in local time, following daylight-saving time.",
        name="from",
        default=0,
        usual="0:00",
    )
    ends_s: int = key(
        _CLOCK_FORM,
        "End; on the next day if not after `from`.",
        name="to",
        default=86_400,
        usual="24:00",
    )
    replicas: int | None = key(
        Whole(0, MAX_REPLICAS, "machines"),
        "Number of replicas within the window. A number set by `fogft scale` overrides it.",
        default=None,
        usual="the pool's",
    )
    max_usd_per_hour: float | None = key(
        Number(MAX_USD_PER_HOUR, "US dollars per hour"),
        "Cap within the window. Replicas that exceed a lower cap are ended, the most expensive "
        "first; one stays.",
        default=None,
        usual="the pool's",
    )


@dataclass(frozen=True)
class ScheduleSpec:
    """Replicas and cap by time of the week; launches start `prelaunch_s` before a window begins."""

    time_zone: str = key(
        Text("a time zone", "write a time zone, such as `time_zone: Europe/Berlin`"),
        "IANA time zone of the windows, such as `America/Los_Angeles`, or `UTC`.",
    )
    windows: tuple[WindowSpec, ...] = key(
        Maps(WindowSpec, "write `windows: [{days: mon-fri, from: 8:00, ...}]`"),
        "The first window that matches applies; outside all windows, the pool's own numbers apply.",
    )
    prelaunch_s: float = 600.0


def _robot_at(written: Any) -> tuple[float, float]:
    is_pair = isinstance(written, list) and len(written) == 2
    if not is_pair or any(isinstance(n, bool) or not isinstance(n, (int, float)) for n in written):
        raise SpecError(
            f"must be a latitude and a longitude, not {written!r:.40}",
            "write degrees, such as `[37.87, -122.26]`",
        )
    if not (-90 <= written[0] <= 90 and -180 <= written[1] <= 180):
        hint = "write `[latitude, longitude]` in degrees"
        raise SpecError(f"{written!r:.40} is not on Earth", hint)
    return float(written[0]), float(written[1])


@dataclass(frozen=True)
class PlacementSpec:
    """How locations are scored, and known distances."""

    latency_weight: float = key(
        Number(100, "times", from_zero=True),
        "Weight of one percent of round trip relative to one percent of price; 0 ignores distance.",
        default=1.0,
    )
    robot_at: tuple[float, float] | None = key(
        Special(
            "latitude and longitude",
            _robot_at,
            {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2},
        ),
        "Where the robot is, in degrees, to estimate distances that cannot be measured.",
        default=None,
        usual="unknown",
    )
    rtt_s: Mapping[str, float] = key(
        Table(
            Number(60, "seconds"),
            Text(
                "a `cloud/region`",
                "write a place such as `aws/us-west-2`",
                only(_LOCATION.fullmatch),
            ),
        ),
        "Known round trips, by `cloud/region`, such as `{aws/us-west-2: 0.021}`; they override "
        "measurements.",
        default_factory=dict,
        usual="measured",
    )


@dataclass(frozen=True)
class TrafficSpec:
    """Load on one service, for cost estimates. Zero if not given."""

    requests_per_s: float = key(
        Number(1e6, "requests", from_zero=True), "Mean over a month.", default=0.0
    )
    request_bytes: float = key(
        Number(1e10, "bytes", from_zero=True),
        "Size of one request; clouds do not charge for ingress.",
        default=0.0,
    )
    response_bytes: float = key(
        Number(1e10, "bytes", from_zero=True),
        "Size of one response; each replica that is asked sends one.",
        default=0.0,
    )


@dataclass(frozen=True)
class FallbackSpec:
    """The service on the robot that answers when the replicas do not."""

    service: str = key(
        service_name("write the name of a service on the robot"),
        "Service of the same type that runs on the robot.",
        name="name",
    )
    after_s: float | None = key(
        Number(DAY_S, "seconds"),
        "Call it this long after the request arrived, in parallel with the replicas: the first "
        "answer wins. Must be below `timeout_s`.",
        default=None,
        usual="at the deadline",
    )
    while_none_ready: bool = key(
        Flag(),
        "Call it at once while too few replicas are ready. The robot then sees the service from "
        "the start.",
        default=False,
    )
    limit_s: float = 1.0  # how long past the deadline its answer is awaited
