"""`status.json`: the manager's last observation of its pool, for people and programs.

Owns: the schema, and turning one tick of the manager into it.
Not here: how it is shown (`fogft.cli`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from fogft import __version__
from fogft.model.plain import Moment, from_plain, stored, to_plain
from fogft.model.reason import Cause, Reason
from fogft.model.replica import LinkReport, LinkState, Phase, ReplicaId
from fogft.model.topic import PREFIX, Origin
from fogft.model.topology import Gateway, RobotRoute, Topology, trouble
from fogft.planning.observed.history import OF_NO_REPLICA, Event, EventKind, History
from fogft.pool.manager.proxy_report import Counters, GatewayLink, ProxyReport, TopicCounted
from fogft.reason_words import words

if TYPE_CHECKING:  # `fogft status` reads the schema and must be quick
    from fogft.planning.observed.health import Assessment
    from fogft.pool.manager.reconciler import Tick

VERSION = 1
"""Of the JSON: grows when a key is removed or changes its meaning, not when one is added."""
WORDS = {
    EventKind.LAUNCH: "launched",
    EventKind.REFUSED: "refused",
    EventKind.READY: "ready",
    EventKind.UNREADY: "not ready",
    EventKind.DRAINING: "draining",
    EventKind.UNDRAINED: "kept after all",
    EventKind.FAILED: "failed",
    EventKind.ENDING: "ending",
    EventKind.ENDED: "ended",
    EventKind.GONE: "gone",
    EventKind.CLOCK: "clock set",
    EventKind.SLEPT: "slept",
    EventKind.UPDATING: "updating",
    EventKind.UPDATE_STOPPED: "update stopped",
    EventKind.PROXY_REPLACED: "proxy replaced",
}


@dataclass(frozen=True)
class ReplicaStatus:
    """One replica with its `LinkReport`. Ages and durations in seconds; None: unknown.

    Attributes:
        verdict: ``good``, ``failed``, ``leaving``, ``unresponsive``, ``stuck``, ``disagrees`` or
            ``at risk``.
        age_s: Time since its launch; None if the manager did not launch it.
        reason: Why the verdict is not ``good``, as ``{cause, ...}``; None when it is.
        known: Whether `phase` and `link` are known now; if not, `phase` is the last one seen.
        has_served: Whether it was ready before: if it is ``starting`` now, it has lost its
            service, or cannot be reached.
        provisioning_s: From its order until the machine ran; then `setup_s` until `setup` was done
            and `starting_s` until it was ready. None if it is unknown, or not over.
    """

    slot: int
    generation: int
    phase: str = field(metadata={"words": tuple(phase.value for phase in Phase)})
    verdict: str = "good"
    location: str = "by hand"
    instance: str = ""
    spot: bool = False
    usd_per_hour: float = 0.0
    endpoint: str | None = None
    link: str = field(default="", metadata={"words": ("", *(state.value for state in LinkState))})
    rtt_s: float | None = None
    silent_for_s: float = 0.0
    won: int = 0
    in_flight: int = 0
    restarts: int = 0
    age_s: float | None = None
    detail: str = ""
    differs: bool = False
    differing: tuple[str, ...] = ()
    reason: Reason | None = None
    known: bool = True
    has_served: bool = False
    lease_left_s: float | None = None
    strangers: int = 0
    version: str = ""
    provisioning_s: float | None = None
    setup_s: float | None = None
    starting_s: float | None = None
    ready_after_s: float | None = None

    def linked(
        self, link: LinkReport | None, services: set[str], *, links_known: bool, stale: bool
    ) -> ReplicaStatus:
        """Return a copy with the current link report; without one, with unknown link fields.

        Args:
            services: Names of all services: a replica with all of these is ready.
            stale: The manager's last observation is too old.
        """
        if link is None:
            return replace(
                self,
                link="",
                rtt_s=None,
                silent_for_s=0.0,
                in_flight=0,
                known=not stale and (links_known or self.phase in _COMING),
                lease_left_s=None,
                detail="it has not been found yet" if self.age_s is None else self.detail,
            )
        is_up, is_known = link.state is LinkState.UP, not stale
        phase = self.phase
        if is_up and (link.ready if stale else services and services <= link.ready):
            is_known = True
            if stale or phase in _COMING:  # before the manager sees it
                phase = (Phase.DRAINING if link.draining else Phase.READY).value
        is_judged = self.reason is not None or link.state is LinkState.CONNECTING
        return replace(
            self,
            **{name: getattr(link, name) for name in _OF_LINK},
            link=link.state.value,
            phase=phase,
            known=is_known,
            detail=(is_judged and not stale and self.detail) or link.detail,
        )


_COMING = (Phase.PROVISIONING.value, Phase.STARTING.value)
_OF_LINK = {one.name for one in fields(ReplicaStatus)} & {one.name for one in fields(LinkReport)}
_OF_LINK -= {"detail"}


@dataclass(frozen=True)
class ServiceStatus:
    """One service: how many replicas answer it, and the proxy's counters (0 if unknown)."""

    name: str
    type: str
    ready_replicas: int = 0
    counters: Counters = field(default_factory=dict)

    @property
    def answers(self) -> bool:
        """Whether enough replicas answer: one, or its `quorum`."""
        return self.ready_replicas >= int(self.counters.get("quorum", 1))


@dataclass(frozen=True)
class TopicStatus:
    """One topic, possibly of an action; `heard_by`: replicas that pass it on, or subscribe, now."""

    name: str
    type: str
    origin: str = field(metadata={"words": tuple(origin.value for origin in Origin)})
    heard_by: Sequence[str] = ()
    counters: TopicCounted = field(default_factory=TopicCounted)


@dataclass(frozen=True)
class UpdateStatus:
    """An update in progress, or the last one if it was given up: for `fault`, in words.

    `done` counts the serving replicas of the version that is wanted now.
    """

    state: str
    done: int
    of: int
    fault: str = ""
    reason: Reason | None = None


@dataclass(frozen=True)
class EventStatus:
    """One event, of `replica` ``slot.generation`` or of none; `detail` is `reason` in words."""

    at: Moment
    event: str = field(metadata={"words": tuple(WORDS.values())})
    replica: str
    location: str
    detail: str
    reason: Reason | None = None


@dataclass(frozen=True)
class _DrawnGateway:
    name: str
    endpoint: str
    through: tuple[str, ...]
    generations: tuple[int, ...]


@dataclass(frozen=True)
class _Drawn:
    robot: str
    gateways: tuple[_DrawnGateway, ...]
    robots: Mapping[str, tuple[str, ...]]
    through: tuple[str, ...]
    links: tuple[GatewayLink, ...]


def _check_drawn(raw: Mapping[str, Any]) -> None:
    if raw:
        drawn = from_plain(_Drawn, raw)
        gateways = tuple(Gateway(one.name, one.endpoint, one.through) for one in drawn.gateways)
        routes = tuple(RobotRoute(name, through) for name, through in drawn.robots.items())
        if wrong := trouble(Topology(gateways, routes, drawn.through)):
            raise ValueError(wrong)


@dataclass(frozen=True)
class PoolStatus:
    """The status of a pool.

    Attributes:
        cloud_reachable: Whether the cloud could say what exists; if not, `replicas` are the
            last known ones and `ready` is 0.
        by_hand: Manually started replicas, which are not in `replicas`.
        ready: The number of replicas whose services answer and that are to stay.
        credentials_end_at: When the cloud's credentials end, in seconds since the epoch; None if no
            end is known.
        usd_to_date: What the pool has cost since its first `up`, as the manager saw it.
        notes: Why the pool is not yet as wanted, in sentences.
        reasons: The same, one for each note, as ``{cause, ...}``.
        topology: ``{robot, gateways, robots, through, links}``: who connects through whom, and
            how this machine's robot reaches its gateways; empty without gateways.
        manager_version: The manager's version of fogft; empty before 0.2.0.
    """

    pool: str
    uid: str
    cloud: str
    file: str
    epoch: int = 0
    manager_pid: int = 0
    observed_at: Moment = 0.0
    cloud_reachable: bool = False
    stopping: bool = False
    target: int = 0
    ready: int = 0
    uplink_suspected: bool = False
    usd_per_hour: float = 0.0
    proxy_pid: int | None = None
    proxy_alive: bool = False
    usd_to_date: float = 0.0
    credentials_end_at: float | None = None
    ended: str = ""
    excluded: Sequence[str] = ()
    notes: Sequence[str] = ()
    reasons: Sequence[Reason] = ()
    replicas: Sequence[ReplicaStatus] = ()
    by_hand: Sequence[ReplicaStatus] = ()
    services: Sequence[ServiceStatus] = ()
    topics: Sequence[TopicStatus] = ()
    events: Sequence[EventStatus] = ()
    applied: str = ""
    update: UpdateStatus | None = None
    topology: Annotated[Mapping[str, Any], _check_drawn] = field(default_factory=dict)
    manager_version: str = ""
    proxy_version: str = ""
    version: int = VERSION

    def joined(
        self,
        report: ProxyReport | None,
        *,
        proxy_alive: bool,
        links: Sequence[LinkReport] | None,
        stale: bool = False,
    ) -> PoolStatus:
        """Return a copy completed with the client proxy's report.

        Args:
            report: The last report, however old.
            links: The current links; None if unknown.
        """
        up = [link for link in links or () if link.state is LinkState.UP]
        by_id = {(link.id.slot, link.id.generation): link for link in links or ()}
        services, topics = (report.services, report.topics) if report is not None else ({}, {})
        names, now = {one.name for one in self.services}, report if proxy_alive else None

        def linked(one: ReplicaStatus) -> ReplicaStatus:
            link = by_id.get((one.slot, one.generation))
            return one.linked(link, names, links_known=links is not None, stale=stale)

        replicas = [linked(one) for one in self.replicas]
        topology = self.topology
        if topology and now is not None and links is not None:
            said = [to_plain(one) for one in now.gateways]
            topology = {**topology, "robot": now.robot, "links": said}
        return replace(
            self,
            proxy_alive=proxy_alive,
            proxy_version=now.version if now is not None else "",
            proxy_pid=now.pid if now is not None else None,
            replicas=replicas,
            by_hand=[linked(one) for one in self.by_hand],
            ready=sum(one.known and one.phase == "ready" and one.link == "up" for one in replicas),
            services=[
                replace(
                    one,
                    ready_replicas=sum(one.name in link.ready for link in up),
                    counters=services.get(one.name, one.counters),
                )
                for one in self.services
            ],
            topics=[
                replace(
                    one,
                    heard_by=sorted(k.id.short for k in up if PREFIX + one.name in k.ready),
                    counters=topics.get(one.name, one.counters),
                )
                for one in self.topics
            ],
            topology=topology,
        )


def from_json(raw: Any, path: Path) -> PoolStatus:
    """Read a status from a file."""
    hint = "remove it: the manager writes a new one"
    return stored(PoolStatus, raw, f"`{path}` is not a status file", hint)


def of_tick(
    tick: Tick, history: History, recent: Sequence[Event], notes: Sequence[Reason] = ()
) -> PoolStatus:
    """Return the status after a tick, as known to the manager and the cloud."""
    from fogft.model.groups import FIRST_BY_HAND

    health, observed, plan = tick.plan.health, tick.observed, tick.plan
    judged = health.replicas if health is not None else ()
    draining = set(plan.draining) | {end.id for end in plan.terminations} | observed.ending
    replicas = [_replica(one, draining, history, observed.now) for one in judged]
    members = tick.membership.members if tick.membership is not None else ()
    by_hand = [member.id for member in members if member.id.slot >= FIRST_BY_HAND]
    gateways = tick.membership.topology.gateways if tick.membership is not None else ()
    bare = [Reason(Cause.NO_CERTIFICATE, name=g.name) for g in gateways if not g.generations]
    said = [*plan.notes, *bare, *notes]
    starting, update = Phase.STARTING.value, None
    if (one := tick.update) is not None:
        update = UpdateStatus(one.state.value, one.done, one.of, words(one.fault), one.fault)
    return PoolStatus(
        pool=tick.identity.name,
        uid=tick.identity.uid,
        cloud=tick.identity.cloud,
        file=tick.identity.file,
        observed_at=observed.now,
        cloud_reachable=observed.machines is not None,
        stopping=tick.intent.stopping,
        target=plan.wanted,
        ready=sum(replica.phase == Phase.READY.value for replica in replicas),
        uplink_suspected=bool(health and health.uplink_suspected),
        usd_per_hour=sum(
            machine.usd_per_hour
            for machine in (*(one.machine for one in judged), *observed.gateway, *observed.standbys)
        ),
        excluded=sorted(tick.intent.excluded),
        notes=[words(note) for note in said],
        reasons=said,
        replicas=replicas,
        by_hand=[ReplicaStatus(one.slot, one.generation, starting) for one in by_hand],
        services=[ServiceStatus(one.name, one.type) for one in tick.spec.proxied],
        topics=[TopicStatus(one.name, one.type, one.origin.value) for one in tick.spec.topics],
        events=[event_status(event) for event in recent],
        topology=_topology(tick),
        applied=tick.file,
        manager_version=__version__,
        update=update,
    )


def _topology(tick: Tick) -> dict[str, Any]:
    here = tick.membership.topology if tick.membership is not None else tick.spec.topology
    if not here:
        return {}
    return {
        "robot": "",
        "gateways": [vars(one) for one in here.gateways],
        "robots": here.robots,
        "through": here.through,
        "links": [],
    }


def _replica(
    one: Assessment, draining: set[ReplicaId], history: History, now: float
) -> ReplicaStatus:
    machine = one.machine
    record = history.record(one.id.slot, one.id.generation)
    launched_at = record.launched_at if record is not None else machine.launched_at
    ready_at = record.first_ready_at if record is not None else None
    drains = one.id in draining and one.phase is not Phase.GONE
    return ReplicaStatus(
        slot=one.id.slot,
        generation=one.id.generation,
        phase=(Phase.DRAINING if drains else one.phase).value,
        verdict=one.verdict.value,
        location=machine.placement.location,
        instance=machine.placement.instance,
        spot=machine.placement.spot,
        usd_per_hour=machine.usd_per_hour,
        endpoint=machine.endpoint,
        age_s=max(0.0, now - launched_at),
        detail=words(one.why) or machine.progress,
        reason=one.why,
        has_served=ready_at is not None,
        provisioning_s=_between(launched_at, machine.running_at),
        setup_s=_between(machine.running_at, machine.set_up_at),
        starting_s=_between(machine.set_up_at, ready_at),
        ready_after_s=_between(launched_at, ready_at),
    )


def _between(begin: float, end: float | None) -> float | None:
    """Return how long a phase of a launch took; None if that is not known."""
    return max(0.0, end - begin) if begin and end else None


def event_status(event: Event) -> EventStatus:
    """Return an event in its status form."""
    return EventStatus(
        at=event.at,
        event=WORDS[event.kind],
        replica="" if event.kind in OF_NO_REPLICA else f"{event.slot}.{event.generation}",
        location=event.location,
        detail=words(event.reason),
        reason=event.reason,
    )
