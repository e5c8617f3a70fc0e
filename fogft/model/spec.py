"""What a pool file asks for, as values. Reading and judging the file is `spec_reader`'s."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Any

from fogft.model.choices import (
    AvailabilitySpec,
    Compression,
    FallbackSpec,
    Freshness,
    GroupSpec,
    MetricsSpec,
    MigrationSpec,
    OnDemandSpec,
    PlacementSpec,
    ScheduleSpec,
    TrafficSpec,
)
from fogft.model.middleware import Middleware, Speaks
from fogft.model.topic import TopicSpec
from fogft.model.topology import Topology
from fogft.model.uplinks import UplinkPolicy
from fogft.poolfile.state import StateSpec

MAX_REPLICAS = 16
# Keys of `resources` that say where a machine may be, not what it is.
_WHEREABOUTS = frozenset({"infra", "cloud", "region", "zone", "any_of", "ordered", "job_recovery"})


class OnTimeout(str, Enum):
    """What the caller gets when no replica answered before the deadline."""

    SILENT = "silent"  # no response: an empty list of obstacles is never mistaken for a clear road
    EMPTY = "empty"  # a default-constructed response, as in the paper
    FALLBACK = "fallback"  # the response of another service, on the robot


class HedgingMode(str, Enum):
    """How many replicas a request is sent to."""

    ALL = "all"  # every one, at once
    ADAPTIVE = "adaptive"  # the best; the next when that takes unusually long
    FAILOVER = "failover"  # one; another when that fails


class Advertise(str, Enum):
    """When the service is there on the robot: what `wait_for_service` tells."""

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
    """One proxied service.

    Attributes:
        timeout_s: From the request's arrival at the client proxy to its deadline.
        ok_field: Name of a boolean response field that must be true while another
            attempt is left; empty for none.
        hedging_budget: Extra copies under `adaptive`, as a share of requests.
        replicas: At least so many carry it; 0 for as many as the pool has.
        traffic: What is asked of it, for costs.
        concurrency: Requests that a replica gives the service at once; 0 to learn it.
        fallback: Who answers at the deadline, or before; only with `on_timeout: fallback`.
        advertise: When the service is offered on the robot; None for what `advertised` says.
        trace: Whether each request leaves a line in the client proxy's `trace.jsonl`.
        cancel: Name of the service's cancel service (`std_srvs/srv/Trigger`); empty for none.
        quorum: The answer is the one that so many replicas agree on; 1 for the first.
        tolerance: Path of a float field of the response -> how far apart still agrees.
        state: How its state is taken and given; None for a service that keeps none.
        uplinks: Which of the robot's uplinks its requests take.
        freshness: Which goes first where several wait.
        compression: Whether payloads are compressed on thin links.
        part: Which part of an action it is.
    """

    name: str
    type: str
    timeout_s: float = 10.0
    on_timeout: OnTimeout = OnTimeout.SILENT
    ok_field: str = ""
    hedging: HedgingMode = HedgingMode.ALL
    hedging_budget: float = 0.1
    replicas: int = 0
    traffic: TrafficSpec = field(default_factory=TrafficSpec)
    concurrency: int = 0
    cancel: str = ""
    quorum: int = 1
    tolerance: tuple[tuple[str, float], ...] = ()
    state: StateSpec | None = None
    fallback: FallbackSpec | None = None
    trace: bool = False
    uplinks: UplinkPolicy = UplinkPolicy.PREFER
    freshness: Freshness = Freshness.EVERY
    compression: Compression = Compression.AUTO
    advertise: Advertise | None = None
    part: Part = Part.NONE

    @property
    def needs_type(self) -> bool:
        """Whether the policy looks into responses, or makes one: the type must be loadable."""
        looks = bool(self.ok_field) or self.quorum > 1 or self.state is not None
        return looks or self.on_timeout is OnTimeout.EMPTY

    @property
    def advertised(self) -> Advertise:
        """When it is offered: as told; else while it can be answered.

        One that is answered with no replica at all, or whose requests are kept in order, stays.
        """
        if self.advertise is not None:
            return self.advertise
        stays = self.on_timeout is not OnTimeout.SILENT or self.state is not None
        return Advertise.ONCE_READY if stays else Advertise.WHILE_READY


@dataclass(frozen=True)
class HealthSpec:
    """When a replica is doubted, and when it is replaced. Seconds.

    Attributes:
        suspect_after_s: Probes unanswered for so long: nothing more is sent there.
        replace_after_s: Suspect for so long, while others answer: it is replaced.
        start_limit_s: Not ready so long after its launch: the launch has failed.
        orphan_after_s: A replica that hears of no manager for so long ends itself.
    """

    suspect_after_s: float = 2.0
    replace_after_s: float = 15.0
    start_limit_s: float = 900.0
    orphan_after_s: float = 3600.0


@dataclass(frozen=True)
class PoolSpec:
    """A whole pool file.

    Attributes:
        name: The pool's name: lower-case letters, digits and dashes, at most 40.
        services: At least one, names distinct.
        replicas: How many should be ready. With groups: their sum. With an availability
            target: the fewest.
        max_surge: How many more may exist while one replaces another.
        max_usd_per_hour: Cap on the price of all machines together, surge included;
            None for no cap.
        max_hours: After so many hours the pool ends by itself; None for never.
        availability: A target from which the number follows; None for none.
        groups: Kinds of machines; none for one kind, the task's `resources`.
        on_demand: How spot and on-demand are mixed, where there are no groups.
        migration: When a replica moves to a better location; None for never.
        rendezvous: ``host:port`` of each rendezvous.
        dial_in: ``host:port`` where replicas dial the robot; empty where the robot dials them.
        topology: Who talks through whom.
        uplinks: Network interfaces of this machine's robot, the preferred one first; none for
            whatever its routes say.
        metrics: Where processes listen for Prometheus.
        topics: What passes besides services; those of actions are among them.
        rmw: How the proxies speak ROS.
        task: The SkyPilot task: the file without its `fogft` section.
    """

    name: str
    services: tuple[ServiceSpec, ...]
    replicas: int = 2
    max_surge: int = 1
    max_usd_per_hour: float | None = None
    max_hours: float | None = None
    health: HealthSpec = field(default_factory=HealthSpec)
    availability: AvailabilitySpec | None = None
    placement: PlacementSpec = field(default_factory=PlacementSpec)
    on_demand: OnDemandSpec = field(default_factory=OnDemandSpec)
    groups: tuple[GroupSpec, ...] = ()
    schedule: ScheduleSpec | None = None
    migration: MigrationSpec | None = field(default_factory=MigrationSpec)
    rendezvous: tuple[str, ...] = ()
    dial_in: str = ""
    topology: Topology = field(default_factory=Topology)
    uplinks: tuple[str, ...] = ()
    metrics: MetricsSpec = field(default_factory=MetricsSpec)
    topics: tuple[TopicSpec, ...] = ()
    rmw: Middleware = field(default_factory=Middleware)
    task: Mapping[str, Any] = field(default_factory=dict)
    discovered: tuple[ServiceSpec, ...] = ()

    @cached_property
    def derived(self) -> dict[Any, Any]:
        """Where `groups` keeps what it worked out of this spec, which never changes."""
        return {}

    @property
    def proxied(self) -> tuple[ServiceSpec, ...]:
        """The services that robots are offered: the file's, or what was discovered."""
        return self.services or self.discovered

    @cached_property
    def replica_hash(self) -> str:
        """16 hexadecimal digits that change when running replicas must be replaced.

        Covers what a replica runs and serves, and the machine it needs; not how many
        there are, how long the robot waits, or where machines may be.
        """
        return self.hash_with(self.services, self.task.get("resources"))

    def hash_with(self, services: tuple[ServiceSpec, ...], resources: Any) -> str:
        """Return the `replica_hash` of a replica that carries only these services.

        Args:
            services: What it carries.
            resources: What its machine must be: the section of the file that holds for it.
        """
        asked: dict[str, Any] = {
            "services": sorted(_run_by_replica(s) for s in services),
            "orphan_after_s": self.health.orphan_after_s,
            "task": {k: v for k, v in self.task.items() if k not in ("name", "resources")},
        }
        if self.topics:
            asked["topics"] = sorted(str(topic) for topic in self.topics)
        if self.rendezvous or self.dial_in:
            asked["connectivity"] = [self.rendezvous, self.dial_in]
        if self.rmw.replica is not Speaks.RCLPY:
            asked["rmw"] = self.rmw.replica.value
        kinds = _kinds_of_machine(resources)
        if kinds != ["{}"]:
            asked["machine"] = kinds
        canonical = json.dumps(asked, sort_keys=True, default=str)
        return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def _run_by_replica(service: ServiceSpec) -> tuple[str, ...]:
    """Return what of a service concerns its replicas; no more than was always there if unset."""
    policy = (str(service.concurrency), service.cancel)
    state = () if service.state is None else (str(service.state),)
    return (service.name, service.type, *(policy if policy != ("0", "") else ()), *state)


def _kinds_of_machine(resources: Any) -> list[str]:
    """Return what the machines of a `resources` section are, without where: each kind once."""
    section = resources if isinstance(resources, Mapping) else {}
    choices = section.get("any_of") or section.get("ordered") or [{}]
    kinds = set()
    for choice in choices if isinstance(choices, list) else [{}]:
        merged = {**section, **(choice if isinstance(choice, Mapping) else {})}
        kind = {key: value for key, value in merged.items() if key not in _WHEREABOUTS}
        kinds.add(json.dumps(kind, sort_keys=True, default=str))
    return sorted(kinds)
