"""The contents of a pool file, as values. Each field made by `key` is a key of the file."""

from __future__ import annotations

import hashlib
import ipaddress
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import Any

from fogft import __version__
from fogft.model.choices import (
    MAX_REPLICAS,
    MAX_USD_PER_HOUR,
    AvailabilitySpec,
    Compression,
    FallbackSpec,
    Freshness,
    GroupSpec,
    MetricsSpec,
    Middleware,
    OnDemandSpec,
    PlacementSpec,
    ScheduleSpec,
    Spread,
    TrafficSpec,
    UplinkPolicy,
    is_interface,
)
from fogft.model.keys import (
    DAY_S,
    Flag,
    Listed,
    Map,
    Maps,
    Number,
    OneOf,
    Table,
    Text,
    Whole,
    key,
    only,
)
from fogft.model.names import LINK_PORT, endpoint
from fogft.model.ros_names import field_path, is_field_name, service_name, service_type
from fogft.model.state import StateSpec
from fogft.model.topic import ActionSpec, TopicSpec
from fogft.model.topology import LAUNCHED, Gateway, LaunchedGateway, Topology

CONCURRENCY_LIMIT = 512  # most requests that a replica holds
MAX_HOURS = 8000  # the certificates last 365 days
# Keys of `resources` that say where a machine may be, not what it is.
_WHEREABOUTS = frozenset({"infra", "cloud", "region", "zone", "any_of", "ordered", "job_recovery"})


class OnTimeout(str, Enum):
    """What the caller gets if no replica answers before the deadline."""

    SILENT = "silent"  # no response: an empty list of obstacles is never mistaken for a clear road
    EMPTY = "empty"  # a default-constructed response, as in the paper
    FALLBACK = "fallback"  # the response of another service, on the robot


class HedgingMode(str, Enum):
    """How many replicas a request is sent to."""

    AUTO = "auto"  # every one while they are idle, the first to answer when they are busy
    ALL = "all"  # every one, at once
    FAILOVER = "failover"  # one; another when that fails


class Advertise(str, Enum):
    """When the service is offered on the robot, as seen by `wait_for_service`."""

    WHILE_READY = "while_ready"  # while some replica can answer
    ONCE_READY = "once_ready"  # from the first replica that can answer, to the pool's end
    ALWAYS = "always"  # from the start


class Part(str, Enum):
    """Which of an action's three services a service is."""

    NONE = ""
    GOAL = "goal"
    RESULT = "result"
    CANCEL = "cancel"


@dataclass(frozen=True)
class ServiceSpec:
    """One proxied service."""

    name: str = key(
        service_name("write a name such as `/detect`"),
        "Name of the service, on the robot and on the replicas; `detect` is `/detect`.",
    )
    type: str = key(
        service_type(
            "write `package/srv/Name`, such as `type: std_srvs/srv/SetBool`", has_parts=True
        ),
        "Type of the service. Must be installed on the robot; with `rmw: zenoh`, only if a policy "
        "reads responses.",
    )
    timeout_s: float = key(
        Number(DAY_S, "seconds"),
        "Time from the request's arrival at the client proxy to its deadline.",
        default=10.0,
        parameter=True,
    )
    on_timeout: OnTimeout = key(
        OneOf(OnTimeout),
        "What the caller gets at the deadline: no response (`silent`, so that no empty list of "
        "obstacles is mistaken for a clear road), a default-constructed one (`empty`), or that of "
        "a service on the robot (`fallback`).",
        default=OnTimeout.SILENT,
        parameter=True,
    )
    ok_field: str = key(
        Text("the name of a field", "name a boolean field, such as `success`", only(is_field_name)),
        "Boolean field of the response; while it is false, fogft waits for another replica's; "
        "if all are false, one is returned.",
        default="",
        parameter=True,
    )
    hedging: HedgingMode = key(
        OneOf(HedgingMode, hints={"adaptive": "is now called `auto`, which is the default"}),
        "How many replicas get a request: all of them while they are idle and fewer as load "
        "rises (`auto`), always all (`all`), or one, and another if it fails (`failover`).",
        default=HedgingMode.AUTO,
        parameter=True,
    )
    traffic: TrafficSpec = key(
        Map(TrafficSpec, "write `{requests_per_s: 10, request_bytes: 100000}`"),
        "Load on the service, for the costs that `fogft plan` shows; measured if not set.",
        default_factory=TrafficSpec,
    )
    concurrency: int = key(
        Whole(1, CONCURRENCY_LIMIT, "requests"),
        "Requests that a replica passes to the service concurrently.",
        default=0,
        usual="learned",
    )
    cancel: str = key(
        service_name("write a service's name, such as `cancel: /detect_cancel`"),
        "Service (`std_srvs/srv/Trigger`) that cancels the running request, called once another "
        "replica has answered.",
        default="",
    )
    quorum: int = key(
        Whole(2, MAX_REPLICAS, "replicas"),
        "Return the response that this many replicas agree on, for deterministic services. A "
        "replica that disagrees 3 times in 20 no longer counts and is replaced.",
        default=1,
        usual="the first",
    )
    tolerance: Mapping[str, float] = key(
        Table(
            Number(1e12, "the field's own"),
            field_path("write a path such as `plan.cost`"),
        ),
        "With `quorum`: how far apart two values of a float field may be, such as "
        "`{plan.poses.pose.position.x: 0.01}`. All other fields must be equal.",
        default_factory=dict,
    )
    state: StateSpec | None = key(
        Map(StateSpec, "write `state: {snapshot: /svc/get_state, restore: /svc/set_state}`"),
        "The service keeps state: all replicas apply all requests in one order, and a new replica "
        "is given the state of another.",
        default=None,
    )
    fallback: FallbackSpec | None = key(
        Map(FallbackSpec, "name a service on the robot, such as `{name: /detect_onboard}`"),
        "With `on_timeout: fallback`: the service on the robot that answers instead.",
        name="fallback_service",
        default=None,
    )
    freshness: Freshness = key(
        OneOf(Freshness),
        "Which of several waiting requests goes first: the one with the nearest deadline "
        "(`every`), or the newest (`latest`), for services whose older requests are worth less.",
        default=Freshness.EVERY,
    )
    trace: bool = key(
        Flag(),
        "Write a line for each request to the client proxy's `trace.jsonl`, or export it as "
        "OpenTelemetry spans if the environment sets OTEL_EXPORTER_OTLP_ENDPOINT.",
        default=False,
        advanced=True,
        parameter=True,
    )
    uplink_policy: UplinkPolicy = key(
        OneOf(UplinkPolicy),
        "With several `uplinks`: use the first that is up (`prefer`), one until it fails "
        "(`failover`), or all at once (`all`).",
        default=UplinkPolicy.PREFER,
        advanced=True,
    )
    compression: Compression = key(
        OneOf(Compression),
        "Compress payloads on slow links where measurements show a gain (`auto`), or never "
        "(`off`).",
        default=Compression.AUTO,
        advanced=True,
    )
    advertise: Advertise | None = key(
        OneOf(Advertise),
        "When the robot sees the service: while a replica can answer (`while_ready`), from the "
        "first that can (`once_ready`), or from the start (`always`).",
        default=None,
        usual="by policy",
        advanced=True,
        parameter=True,
    )
    part: Part = Part.NONE

    @property
    def needs_type(self) -> bool:
        """Whether the policy reads or creates responses, so that the type must be loadable."""
        looks = bool(self.ok_field) or self.quorum > 1 or self.state is not None
        return looks or self.on_timeout is OnTimeout.EMPTY

    @property
    def advertised(self) -> Advertise:
        """When the service is offered: as configured, else while a replica can answer.

        One that answers without replicas, or keeps state, stays offered once a replica was ready.
        """
        if self.advertise is not None:
            return self.advertise
        stays = self.on_timeout is not OnTimeout.SILENT or self.state is not None
        return Advertise.ONCE_READY if stays else Advertise.WHILE_READY


@dataclass(frozen=True)
class HealthSpec:
    """When a replica is suspected, and when it is replaced."""

    suspect_after_s: float = key(
        Number(3600, "seconds"),
        "Mark a replica suspect after this long without a probe reply; it is sent nothing more. A "
        "slow service does not count.",
        default=2.0,
    )
    replace_after_s: float = key(
        Number(DAY_S, "seconds"),
        "Replace a replica that has been suspect for this long while others answer. A pool's only "
        "replica is replaced after four times as long.",
        default=15.0,
    )
    start_limit_s: float = key(
        Number(DAY_S, "seconds"),
        "Give up on a launch that is not ready this long after `setup`, or whose machine is not "
        "running this long after the order. `setup` itself may take an hour.",
        default=900.0,
    )


@dataclass(frozen=True)
class PoolSpec:
    """The contents of a pool file.

    The services and topics of `actions` are among `services` and `topics`; with `groups`,
    `replicas` is their sum.
    """

    name: str = ""
    services: tuple[ServiceSpec, ...] = key(
        Maps(
            ServiceSpec,
            "write a list, such as `services: [{name: /detect, type: my_msgs/srv/Detect}]`",
        ),
        "The services that the robot calls and the replicas run. If omitted, every service that "
        "`run` advertises, except those of ROS itself.",
        default=(),
        usual="what `run` advertises",
    )
    namespace: str = key(
        service_name(
            "write the namespace of the services to offer, such as `namespace: /planner`",
            "a namespace",
        ),
        "If `services` is omitted, offer only services below this namespace.",
        default="",
        usual="any",
    )
    replicas: int = key(
        Whole(1, MAX_REPLICAS, "machines"), "Number of replicas to keep ready.", default=2
    )
    max_surge: int = key(
        Whole(0, 4, "machines"),
        "Extra machines during a replacement, or while none serves. With 0, a machine that still "
        "serves is replaced only if the file changes, and ends before its successor starts.",
        default=3,
    )
    max_usd_per_hour: float | None = key(
        Number(MAX_USD_PER_HOUR, "US dollars per hour"),
        "Cap on the price of all machines together, including those being launched or ended. A "
        "launch that would exceed it waits, and `fogft status` says so.",
        default=None,
        usual="no cap",
    )
    max_hours: float | None = key(
        Number(MAX_HOURS, "hours"),
        "Hours after `fogft up` at which the pool shuts down: replicas, client proxy and manager.",
        default=None,
        usual="never",
    )
    health: HealthSpec = key(
        Map(HealthSpec), "When a replica is suspected and replaced.", default_factory=HealthSpec
    )
    availability: AvailabilitySpec | None = key(
        Map(AvailabilitySpec, short=("target",)),
        "Fraction of time that at least one replica must answer; sets the number of replicas, with "
        "`replicas`, if given, as the minimum. `0.9995` is short for `{target: 0.9995}`.",
        default=None,
    )
    placement: PlacementSpec = key(
        Map(PlacementSpec),
        "How price and distance are weighed, and known distances. Failure domains take precedence.",
        default_factory=PlacementSpec,
    )
    on_demand: OnDemandSpec = key(
        Map(OnDemandSpec),
        "How many machines are on demand; the rest are then spot.",
        default_factory=OnDemandSpec,
    )
    spread: Spread = key(
        OneOf(Spread),
        "With `on_demand.fallback`, how many spot machines one location gets while on-demand ones "
        "are available: at most half of them (`prefer`), or one (`require`).",
        default=Spread.PREFER,
    )
    groups: tuple[GroupSpec, ...] = key(
        Maps(GroupSpec, "write `groups: [{name: anchor, replicas: 1, ...}]`"),
        "Replicas on different kinds of machines, at most eight groups, instead of `replicas` "
        "and `on_demand`. Add new ones at the end: a group is identified by its position.",
        default=(),
    )
    schedule: ScheduleSpec | None = key(
        Map(ScheduleSpec, "write `time_zone` and `windows`"),
        "Replicas and cap by time of the week.",
        default=None,
    )
    migration: bool = key(
        Flag(),
        "`false`: never move a replica to a cheaper or nearer location.",
        default=True,
        advanced=True,
        usual="moves if 30 % better",
    )
    rendezvous: tuple[str, ...] = key(
        Listed(endpoint("write a list, such as `rendezvous: [meet.example.org:7450]`"), 4),
        "Addresses of `fogft rendezvous`, for pools with several robots, gateways, or replicas "
        "whose address the cloud does not know.",
        default=(),
    )
    dial_in: str = key(
        endpoint(
            "write the robot's own address and a port, such as `dial_in: robot.example.org:7460`"
        ),
        "The robot's own address: replicas that cannot be reached dial it.",
        default="",
    )
    link_port: int = key(
        Whole(1024, 65535),
        "Port of a replica's VM that robots connect to. Not 7447, the port of `rmw_zenoh`'s "
        "router.",
        default=LINK_PORT,
        advanced=True,
    )
    allow_from: tuple[str, ...] = key(
        Listed(
            Text(
                "an address or a network",
                "write a list, such as `allow_from: [203.0.113.7, 198.51.100.0/24]`",
                lambda written: str(ipaddress.ip_network(written)),
            ),
            20,
        ),
        "Who may connect to a replica's VM, including its ssh port: the public addresses of the "
        "robots and of the computer that SkyPilot's API server runs on. Enforced on AWS only.",
        default=(),
        usual="anyone",
    )
    topology: Topology = key(
        Map(Topology),
        "Gateways, and which robots use them. Needs a `rendezvous`.",
        default_factory=Topology,
    )
    gateway: LaunchedGateway = key(
        Map(LaunchedGateway, "write `gateway: {launch: true}`"),
        "A gateway that the pool launches for itself.",
        default_factory=LaunchedGateway,
    )
    uplinks: tuple[str, ...] = key(
        Listed(
            Text(
                "a network interface's name",
                "write what `ip link` lists, such as `uplinks: [wlan0, wwan0]`",
                only(is_interface),
            ),
            4,
        ),
        "Network interfaces that this machine's robot uses at once, preferred first. Each needs "
        "its own route to the replicas. Without effect with `dial_in`, where replicas connect.",
        default=(),
        usual="by route",
    )
    metrics: MetricsSpec = key(
        Map(MetricsSpec, "write a map, such as `metrics: {proxy: 127.0.0.1:9464}`"),
        "Addresses at which processes serve Prometheus metrics (`GET /metrics`).",
        default_factory=MetricsSpec,
    )
    topics: tuple[TopicSpec, ...] = key(
        Maps(
            TopicSpec,
            "write a list, such as "
            "`topics: [{name: /map, type: nav_msgs/msg/OccupancyGrid, from: robot}]`",
        ),
        "Topics to forward between the robot and the replicas. Not with `topology`.",
        default=(),
    )
    rmw: Middleware = key(
        Map(Middleware, short=("robot", "replica")),
        "How the proxies talk to ROS nodes: with the installed ROS 2 (`rclpy`), or as `rmw_zenoh` "
        "nodes do, without a ROS installation (`zenoh`). One value for both sides, or a map.",
        default_factory=Middleware,
    )
    actions: tuple[ActionSpec, ...] = key(
        Maps(
            ActionSpec,
            "write a list, such as `actions: [{name: /move, type: my_msgs/action/Move}]`",
        ),
        "Actions that every replica runs. Not with `topology`.",
        default=(),
    )
    spare: bool = key(
        Flag(),
        "Keep a second `run` process on each replica, idle in its own ROS domain, which takes "
        "over when the first dies. For services that start slowly; doubles their memory.",
        default=False,
    )
    unmanaged_max_hours: float = key(
        Number(MAX_HOURS, "hours"),
        "How long replicas keep serving after they last heard from the manager. Then they shut "
        "down their machines, no later than `max_hours`.",
        default=24.0,
    )
    task: Mapping[str, Any] = field(default_factory=dict)  # the file without its `fogft` section
    discovered: tuple[ServiceSpec, ...] = ()  # used if the file names no services
    discovered_by: str = ""  # the hash of the replicas that reported them

    @cached_property
    def derived(self) -> dict[Any, Any]:
        """A cache for values that `groups` derives from this spec, which never changes."""
        return {}

    @property
    def proxied(self) -> tuple[ServiceSpec, ...]:
        """The services offered on robots: the file's, or the discovered ones."""
        return self.services or self.discovered

    @property
    def dials_out(self) -> bool:
        """Whether replicas dial a robot or a gateway, so that nothing has to reach them."""
        return bool(self.dial_in) or self.gateway.launch

    def behind(self, host: str) -> PoolSpec:
        """Return this spec with its launched gateway at `host`: all traffic goes through it."""
        gateway, rendezvous, door = self.gateway.endpoints(host)
        topology = Topology((Gateway(LAUNCHED, gateway),), through=(LAUNCHED,))
        return replace(self, topology=topology, rendezvous=(rendezvous,), dial_in=door)

    @cached_property
    def replica_hash(self) -> str:
        """16 hexadecimal digits that change when running replicas must be replaced.

        Covers what a replica runs and serves, its fogft, and the machine it needs; not how
        many there are, how long the robot waits, or where machines may be.
        """
        return self.hash_with(self.task.get("resources"))

    def hash_with(self, resources: Any) -> str:
        """Return the `replica_hash` of a replica with these `resources`."""
        asked = {
            "fogft": __version__,
            "services": sorted(
                str((one.name, one.type, one.concurrency, one.cancel, one.state))
                for one in self.services
            ),
            "topics": sorted(map(str, self.topics)),
            "connectivity": (self.rendezvous, self.dial_in, self.link_port, self.allow_from),
            "spare": self.spare,
            "rmw": self.rmw.replica,
            "task": {k: v for k, v in self.task.items() if k not in ("name", "resources")},
            "machine": _kinds_of_machine(resources),
        }
        canonical = json.dumps(asked, sort_keys=True, default=str)
        return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def _kinds_of_machine(resources: Any) -> list[str]:
    """Return the kinds of machine in a `resources` section, each once, without their locations."""
    section = resources if isinstance(resources, Mapping) else {}
    choices = section.get("any_of") or section.get("ordered") or [{}]
    kinds = set()
    for choice in choices if isinstance(choices, list) else [{}]:
        merged = {**section, **(choice if isinstance(choice, Mapping) else {})}
        kind = {key: value for key, value in merged.items() if key not in _WHEREABOUTS}
        kinds.add(json.dumps(kind, sort_keys=True, default=str))
    return sorted(kinds)
