"""`status.json`: what the manager last saw of its pool, for people and programs.

Owns: the schema, and turning one tick of the manager into it.
Not here: how it is shown (`fogft.cli`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from fogft import __version__
from fogft.model.plain import Moment, Seconds, from_plain, stored, to_plain
from fogft.model.reason import Cause, Reason
from fogft.model.replica import LinkReport, LinkState, Phase, ReplicaId
from fogft.model.topic import PREFIX, Origin
from fogft.model.topology import Gateway, RobotRoute, Topology, trouble
from fogft.planning.observed.history import MOVING, Event, EventKind, History
from fogft.pool.manager.proxy_report import Counters, ProxyReport, TopicCounted
from fogft.reason_words import words

if TYPE_CHECKING:  # `fogft status` reads the schema and must be quick
    from fogft.model.replica import Machine
    from fogft.model.spec import PoolSpec
    from fogft.planning.observed.health import Assessment
    from fogft.planning.observed.history import Record
    from fogft.pool.manager.reconciler import Tick

T = TypeVar("T")

VERSION = 1
"""Of the JSON form: goes up when a key goes or changes what it means, not when one comes."""
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
}


@dataclass(frozen=True)
class ReplicaStatus:
    """One replica. Ages and durations in seconds; None for unknown.

    Attributes:
        link: ``connecting``, ``up`` or ``suspect``; empty when there is no link.
        verdict: ``good``, ``failed``, ``leaving``, ``unresponsive``, ``stuck`` or
            ``at risk``.
        age_s: Since its launch; None where that was somebody else's.
        differs: The type of a service is not the same there as here; `detail` says how.
        differing: The services of such types.
        reason: Why the verdict is not ``good``, as ``{cause, ...}``; None when it is.
        known: Whether `phase` and `link` are known now; else `phase` is what was last seen.
        has_served: Whether it was ready before: one that is ``starting`` then has lost its
            service, or cannot be reached.
        lease_left_s: Until it shuts down unless it hears of the manager again.
        version: Of fogft on the replica; empty where it is not known.
        provisioning_s: From its order until the machine ran; then `setup_s` until `setup` was done
            and `starting_s` until it was ready. None where it is not known, or not over.
        ready_after_s: From its order until it was ready for the first time.
    """

    slot: int
    generation: int
    phase: str = field(metadata={"words": tuple(phase.value for phase in Phase)})
    verdict: str
    location: str
    instance: str
    spot: bool
    usd_per_hour: float
    endpoint: str | None
    link: str = field(metadata={"words": ("", *(state.value for state in LinkState))})
    rtt_s: float | None
    silent_for_s: float
    won: int
    in_flight: int
    restarts: int
    age_s: float | None
    detail: str
    differs: bool = False
    differing: Sequence[str] = ()
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


@dataclass(frozen=True)
class ServiceStatus:
    """One service: how many replicas answer it, and the proxy's counters (0 when unknown)."""

    name: str
    type: str
    ready_replicas: int
    counters: Counters = field(default_factory=dict)


@dataclass(frozen=True)
class TopicStatus:
    """One topic, of an action or by itself.

    Attributes:
        origin: Who publishes, ``robot`` or ``replicas``.
        heard_by: The replicas, as ``slot.generation``, that pass it on now: of a topic of the
            robot's those where a node subscribes.
        counters: What the client proxy counted.
    """

    name: str
    type: str
    origin: str = field(metadata={"words": tuple(origin.value for origin in Origin)})
    heard_by: Sequence[str] = ()
    counters: TopicCounted = field(default_factory=TopicCounted)

    def seen(self, links: Iterable[LinkReport], counted: Mapping[str, TopicCounted]) -> TopicStatus:
        """Return it as links and counters say it is now."""
        key = PREFIX + self.name
        ups = (one for one in links if one.state is LinkState.UP and key in one.ready)
        return replace(
            self,
            heard_by=sorted(one.id.short for one in ups),
            counters=counted.get(self.name, self.counters),
        )


@dataclass(frozen=True)
class UpdateStatus:
    """An update under way, or the last one where it was given up.

    Attributes:
        state: ``in progress``, ``stopped`` or ``rolled back``.
        done: Replicas of the version that is wanted now which serve.
        of: How many are wanted.
        fault: Why it was given up, in words; empty while it was not.
        reason: The same as ``{cause, ...}``.
    """

    state: str
    done: int
    of: int
    fault: str = ""
    reason: Reason | None = None


@dataclass(frozen=True)
class EventStatus:
    """Something that happened.

    Attributes:
        at: Seconds since the epoch.
        event: In a word or three; see `WORDS`.
        replica: ``slot.generation``; empty for what is of no replica.
        detail: Why, in words; `reason` is the same as ``{cause, ...}``.
    """

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
class _DrawnLink:
    name: str
    state: str
    rtt_s: Seconds | None
    detail: str


@dataclass(frozen=True)
class _Drawn:
    robot: str
    gateways: tuple[_DrawnGateway, ...]
    robots: Mapping[str, tuple[str, ...]]
    through: tuple[str, ...]
    links: tuple[_DrawnLink, ...]


def _check_drawn(raw: Mapping[str, Any]) -> None:
    if raw:
        drawn = from_plain(_Drawn, raw)
        gateways = tuple(Gateway(one.name, one.endpoint, one.through) for one in drawn.gateways)
        routes = tuple(RobotRoute(name, through) for name, through in drawn.robots.items())
        if wrong := trouble(Topology(gateways, routes, drawn.through)):
            raise ValueError(wrong)


@dataclass(frozen=True)
class PoolStatus:
    """The whole pool.

    Attributes:
        observed_at: Seconds since the epoch.
        cloud_reachable: Whether the cloud could say what exists; if not, `replicas` is
            what was seen last and `ready` is 0.
        by_hand: Replicas that people started themselves, beside those of `replicas`.
        target: Replicas wanted now.
        ready: Replicas whose services answer and that are to stay.
        credentials_end_at: When the cloud's credentials end, in seconds since the epoch; None where
            no end is known.
        usd_to_date: What the pool has cost since its first `up`, as the manager saw it.
        ended: Why the manager has ended the pool by itself; empty while it runs.
        notes: Why the pool is not yet as wanted, in sentences.
        reasons: The same, one for each note, as ``{cause, ...}``.
        version: Of this schema; see `fogft.pool.commands.status_schema`.
        topology: ``{robot, gateways, robots, through, links}``: who talks through whom, and
            how this machine's robot finds its gateways; empty where there are none.
        events: The last things that happened.
        applied: Digest of the pool file that was applied last.
        manager_version: Of fogft, by which the manager runs; empty before 0.2.0.
        proxy_version: The same of the client proxy.
    """

    pool: str
    uid: str
    cloud: str
    file: str
    epoch: int
    manager_pid: int
    observed_at: Moment
    cloud_reachable: bool
    stopping: bool
    target: int
    ready: int
    uplink_suspected: bool
    usd_per_hour: float
    proxy_pid: int | None
    proxy_alive: bool
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

    def to_json(self) -> dict[str, Any]:
        """Return the JSON form."""
        return dict(to_plain(self))


def from_json(raw: Any) -> PoolStatus:
    """Read a status back.

    Raises:
        StateError: It is none, or of another version of fogft.
    """
    return stored(PoolStatus, raw, "not a status", "is the manager of another version?")


def of_tick(
    tick: Tick,
    *,
    history: History,
    report: ProxyReport | None,
    recent: Sequence[Event],
    epoch: int,
    manager_pid: int,
    proxy_alive: bool,
    notes: Sequence[Reason] = (),
    usd_to_date: float = 0.0,
    credentials_end_at: float | None = None,
) -> PoolStatus:
    """Return the status after a tick."""
    from fogft.model.groups import FIRST_BY_HAND

    health, observed, plan = tick.plan.health, tick.observed, tick.plan
    judged = health.replicas if health is not None else ()
    said = [*plan.notes, *_without_certificate(tick), *notes]
    leaving = set(plan.draining) | {end.id for end in plan.terminations} | observed.ending
    replicas = [_replica(one, leaving, history, observed.now) for one in judged]
    links = {link.id: link for link in observed.links or ()}
    members = tick.membership.members if tick.membership is not None else ()
    by_hand = [member.id for member in members if member.id.slot >= FIRST_BY_HAND]
    heard = [one.link for one in judged if one.link is not None]
    heard += [links[id] for id in by_hand if id in links]
    return PoolStatus(
        pool=tick.identity.name,
        uid=tick.identity.uid,
        cloud=tick.identity.cloud,
        file=tick.identity.file,
        epoch=epoch,
        manager_pid=manager_pid,
        observed_at=observed.now,
        cloud_reachable=observed.machines is not None,
        stopping=tick.intent.stopping,
        target=plan.wanted,
        ready=sum(replica.phase == Phase.READY.value for replica in replicas),
        uplink_suspected=bool(health and health.uplink_suspected),
        usd_per_hour=sum(one.machine.usd_per_hour for one in judged),
        usd_to_date=usd_to_date,
        credentials_end_at=credentials_end_at,
        proxy_pid=report.pid if report is not None and proxy_alive else None,
        proxy_alive=proxy_alive,
        excluded=sorted(tick.intent.excluded),
        notes=[words(note) for note in said],
        reasons=said,
        replicas=replicas,
        by_hand=[_started_by_hand(id, links.get(id), tick.spec) for id in by_hand],
        services=_services(tick.spec, heard, report),
        topics=[
            TopicStatus(one.name, one.type, one.origin.value).seen(
                heard, report.topics if report is not None else {}
            )
            for one in tick.spec.topics
        ],
        events=[event_status(event) for event in recent],
        topology=_topology(tick, report if proxy_alive else None),
        applied=tick.file,
        manager_version=__version__,
        proxy_version=report.version if report is not None else "",
        update=_update(tick),
    )


def _update(tick: Tick) -> UpdateStatus | None:
    update = tick.update
    if update is None:
        return None
    fault = update.fault
    return UpdateStatus(update.state.value, update.done, update.of, words(fault), fault)


def _topology(tick: Tick, report: ProxyReport | None) -> dict[str, Any]:
    here = tick.membership.topology if tick.membership is not None else tick.spec.topology
    if not here:
        return {}
    links = [to_plain(one) for one in report.gateways] if report is not None else []
    robot = report.robot if report is not None else ""
    return {
        "robot": robot,
        "gateways": [vars(one) for one in here.gateways],
        "robots": here.robots,
        "through": here.through,
        "links": links,
    }


def _without_certificate(tick: Tick) -> list[Reason]:
    if tick.membership is None:
        return []
    return [
        Reason(Cause.NO_CERTIFICATE, name=gateway.name)
        for gateway in tick.membership.topology.gateways
        if not gateway.generations
    ]


def _replica(
    one: Assessment, leaving: set[ReplicaId], history: History, now: float
) -> ReplicaStatus:
    machine = one.machine
    record = history.record(one.id.slot, one.id.generation)
    launched_at = record.launched_at if record is not None else machine.launched_at
    leaves = one.id in leaving and one.phase is not Phase.GONE
    return replace(
        _linked(one.id, Phase.DRAINING if leaves else one.phase, one.link),
        verdict=one.verdict.value,
        location=machine.placement.location,
        instance=machine.placement.instance,
        spot=machine.placement.spot,
        usd_per_hour=machine.usd_per_hour,
        endpoint=machine.endpoint,
        age_s=max(0.0, now - launched_at),
        detail=_detail(one),
        reason=one.why,
        has_served=record is not None and record.first_ready_at is not None,
        **_phases(launched_at, machine, record),
    )


def _phases(launched_at: float, machine: Machine, record: Record | None) -> dict[str, Any]:
    """Return how long each phase of a launch took, as far as it is known."""
    ready_at = record.first_ready_at if record is not None else None

    def between(begin: float, end: float | None) -> float | None:
        return max(0.0, end - begin) if begin and end else None

    return {
        "provisioning_s": between(launched_at, machine.running_at),
        "setup_s": between(machine.running_at, machine.set_up_at),
        "starting_s": between(machine.set_up_at, ready_at),
        "ready_after_s": between(launched_at, ready_at),
    }


def _started_by_hand(id: ReplicaId, link: LinkReport | None, spec: PoolSpec) -> ReplicaStatus:
    if link is None:
        return replace(_linked(id, Phase.STARTING, None), detail="it was not found yet")
    ready = link.state is LinkState.UP and {s.name for s in spec.services} <= link.ready
    phase = Phase.DRAINING if link.draining else Phase.READY if ready else Phase.STARTING
    return _linked(id, phase, link)


def _linked(id: ReplicaId, phase: Phase, link: LinkReport | None) -> ReplicaStatus:
    """Return what a link says of a replica of which no cloud says anything."""
    known = link or LinkReport(id, LinkState.CONNECTING)
    return ReplicaStatus(
        slot=id.slot,
        generation=id.generation,
        phase=phase.value,
        verdict="good",
        location="by hand",
        instance="",
        spot=False,
        usd_per_hour=0.0,
        endpoint=None,
        link=link.state.value if link is not None else "",
        rtt_s=known.rtt_s,
        silent_for_s=known.silent_for_s,
        won=known.won,
        in_flight=known.in_flight,
        restarts=known.restarts,
        strangers=known.strangers,
        age_s=None,
        detail=known.detail,
        differs=known.differs,
        differing=list(known.differing),
        lease_left_s=known.lease_left_s,
        version=known.version,
    )


def _detail(one: Assessment) -> str:
    """Return what is worth knowing of a replica: what is wrong, else what is being done."""
    link, progress = one.link, one.machine.progress
    if one.why is not None:
        return words(one.why)
    if progress and (link is None or link.state is LinkState.CONNECTING):
        return progress
    return link.detail if link is not None else ""


def _services(
    spec: PoolSpec, links: Sequence[LinkReport], report: ProxyReport | None
) -> list[ServiceStatus]:
    counters = report.services if report is not None else {}
    return [
        ServiceStatus(
            name=service.name,
            type=service.type,
            ready_replicas=sum(service.name in link.ready for link in links),
            counters=counters.get(service.name, {}),
        )
        for service in spec.proxied
    ]


def event_status(event: Event) -> EventStatus:
    """Return an event as a status tells it."""
    return EventStatus(
        at=event.at,
        event=WORDS[event.kind],
        replica="" if event.kind in MOVING else f"{event.slot}.{event.generation}",
        location=event.location,
        detail=words(event.reason),
        reason=event.reason,
    )
