"""Worlds for the planner: made by hand with few words, or by hypothesis without mercy."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from hypothesis import strategies as st

from fogft.model.choices import OnDemandSpec, Spread
from fogft.model.groups import STAND_INS, is_stand_in
from fogft.model.intent import Intent
from fogft.model.reason import Cause, Reason
from fogft.model.replica import (
    LinkReport,
    LinkState,
    Machine,
    MachinePhase,
    Observed,
    Offer,
    Placement,
    ReplicaId,
)
from fogft.model.spec import HealthSpec, PoolSpec, ServiceSpec
from fogft.planning.observed.history import Event, EventKind, History
from fogft.planning.planner import Plan, plan
from fogft.planning.sizing import Inputs

UID = "0123456789abcdef"
STRANGER = "fedcba9876543210"
NOW = 1_700_000_000.0
SERVICE = ServiceSpec("/plan", "nav_msgs/srv/GetPlan")
HEALTH = HealthSpec(start_limit_s=300.0)

PLACES = [
    Placement(cloud, region, zone, "m1")
    for cloud, region, zone in (
        ("east", "one", "a"),
        ("east", "one", "b"),
        ("east", "two", "a"),
        ("west", "one", "a"),
    )
]
OFFERS = tuple(Offer(place, 0.1 + 0.01 * index) for index, place in enumerate(PLACES))
ON_DEMAND = tuple(Offer(replace(place, spot=False), 0.3) for place in PLACES)


def spec(replicas: int = 2, **others: object) -> PoolSpec:
    values = {"services": (SERVICE,), "health": HEALTH, "task": {"run": "serve"}, **others}
    return PoolSpec(name="pool", replicas=replicas, **values)  # type: ignore[arg-type]


@dataclass(frozen=True)
class World:
    """All arguments of a plan."""

    spec: PoolSpec
    machines: tuple[Machine, ...] | None = ()
    links: tuple[LinkReport, ...] | None = ()
    events: tuple[Event, ...] = ()
    intent: Intent = field(default_factory=Intent)
    offers: tuple[Offer, ...] = OFFERS
    ending: frozenset[ReplicaId] = frozenset()
    now: float = NOW
    rtt_s: Mapping[str, float] = field(default_factory=dict)

    @property
    def history(self) -> History:
        return History(self.events)

    @property
    def observed(self) -> Observed:
        return Observed(self.now, self.machines, self.links, self.offers, self.ending, self.rtt_s)

    def plan(self) -> Plan:
        return plan(UID, Inputs(self.spec, self.intent, self.observed, self.history))

    def having(self, *parts: Part) -> World:
        """Add replicas."""
        return replace(
            self,
            machines=(*(self.machines or ()), *(p.machine for p in parts)),
            links=(*(self.links or ()), *(p.link for p in parts if p.link is not None)),
            events=tuple(sorted((*self.events, *(e for p in parts for e in p.events)), key=_at)),
        )


def _at(event: Event) -> float:
    return event.at


@dataclass(frozen=True)
class Part:
    """A replica with its link and its past."""

    machine: Machine
    link: LinkReport | None
    events: tuple[Event, ...]


def replica(
    slot: int,
    generation: int = 1,
    *,
    state: str = "ready",
    at: Placement | None = None,
    age_s: float = 100.0,
    silent_s: float = 0.0,
    in_flight: int = 0,
    drained_s: float | None = None,
    unready_s: float | None = None,
    outdated: bool = False,
    price: float = 0.1,
    at_risk: bool = False,
    disagrees: bool = False,
    ignores: bool = False,
    of: PoolSpec | None = None,
) -> Part:
    """Make a replica.

    Args:
        state: ``provisioning``, ``starting``, ``ready``, ``unready``, ``silent``,
            ``failed`` or ``noticed`` (ready, with a preemption notice).
        silent_s: For ``silent``: how long.
        drained_s: Marked as draining so long ago.
        unready_s: For ``unready``: since when.
    """
    id = ReplicaId(UID, slot, generation)
    phase = {"provisioning": MachinePhase.PROVISIONING, "failed": MachinePhase.FAILED}
    machine = Machine(
        id=id,
        placement=at or PLACES[slot % len(PLACES)],
        phase=phase.get(state, MachinePhase.RUNNING),
        launched_at=NOW - age_s,
        endpoint=f"h:{1000 + slot}",
        notice=state == "noticed",
        usd_per_hour=price,
        spec_hash="old" if outdated else (of or spec()).replica_hash,
        failure=Reason(Cause.ERROR, words="boom") if state == "failed" else None,
    )
    link_state = {"silent": LinkState.SUSPECT, "starting": LinkState.CONNECTING}
    serving = state in ("ready", "noticed")
    link: LinkReport | None = LinkReport(
        id,
        link_state.get(state, LinkState.UP),
        ready=frozenset({SERVICE.name}) if serving else frozenset(),
        silent_for_s=silent_s,
        in_flight=in_flight,
        at_risk=at_risk,
        disagrees=disagrees or ignores,
        ignores=ignores,
    )
    if state in ("provisioning", "failed"):
        link = None
    location = machine.placement.location
    events = [Event(NOW - age_s, EventKind.LAUNCH, slot, generation, location)]
    if state in ("ready", "noticed", "silent", "unready"):
        events.append(Event(NOW - age_s + 1, EventKind.READY, slot, generation))
    if unready_s is not None:
        events.append(Event(NOW - unready_s, EventKind.UNREADY, slot, generation))
    if drained_s is not None:
        events.append(Event(NOW - drained_s, EventKind.DRAINING, slot, generation))
    return Part(machine, link, tuple(events))


def applied(world: World, planned: Plan) -> World:
    """Return the world while a plan is carried out: ordered, marked, not yet gone."""
    events = list(world.events)
    for launch in planned.launches:
        location = launch.offer.placement.location
        events.append(Event(world.now, EventKind.LAUNCH, launch.slot, launch.generation, location))
    marked = {(r.slot, r.generation) for r in world.history.open() if r.draining_since is not None}
    for id in planned.draining:
        if (id.slot, id.generation) not in marked:
            events.append(Event(world.now, EventKind.DRAINING, id.slot, id.generation))
    new = tuple(
        Machine(
            ReplicaId(UID, launch.slot, launch.generation),
            launch.offer.placement,
            MachinePhase.PROVISIONING,
            world.now,
            usd_per_hour=launch.offer.usd_per_hour,
            spec_hash=world.spec.replica_hash,
        )
        for launch in planned.launches
    )
    return replace(
        world,
        machines=(*(world.machines or ()), *new),
        events=tuple(events),
        ending=world.ending | {end.id for end in planned.terminations},
    )


def elapsed(world: World, seconds: float) -> World:
    """Return the world later: what was to end is gone, what was ordered serves."""
    machines = [m for m in world.machines or () if m.id not in world.ending]
    events = list(world.events)
    events += [
        Event(world.now, EventKind.ENDED, id.slot, id.generation) for id in sorted(world.ending)
    ]
    old_links = {link.id: link for link in world.links or ()}
    links = []
    for index, machine in enumerate(machines):
        if machine.id.pool_uid != UID:
            continue
        record = world.history.record(machine.id.slot, machine.id.generation)
        link = old_links.get(machine.id)
        if machine.phase is MachinePhase.PROVISIONING:
            machines[index] = replace(machine, phase=MachinePhase.RUNNING, endpoint="h:1")
            link = LinkReport(machine.id, LinkState.UP, frozenset({SERVICE.name}))
        if link is None:
            link = LinkReport(machine.id, LinkState.UP, frozenset({SERVICE.name}))
        if link.ready and (record is None or record.first_ready_at is None):
            events.append(
                Event(world.now + seconds, EventKind.READY, machine.id.slot, machine.id.generation)
            )
        if link.silent_for_s:
            link = replace(link, silent_for_s=link.silent_for_s + seconds)
        links.append(link)
    return replace(
        world,
        machines=tuple(machines),
        links=tuple(links),
        events=tuple(events),
        ending=frozenset(),
        now=world.now + seconds,
    )


# -- hypothesis ------------------------------------------------------------------------------

STATES = ["provisioning", "starting", "ready", "ready", "ready", "unready", "silent", "failed",
          "noticed"]  # fmt: skip


@st.composite
def parts(draw: st.DrawFn, of: PoolSpec, slot: int, generation: int) -> Part:
    state = draw(st.sampled_from(STATES))
    age = st.one_of(st.floats(2, 250), st.floats(250, 2000))
    return replica(
        slot,
        generation,
        state=state,
        at=replace(draw(st.sampled_from(PLACES)), spot=not is_stand_in(slot)),
        age_s=draw(age),
        silent_s=draw(st.floats(2.5, 100)) if state == "silent" else 0.0,
        in_flight=draw(st.integers(0, 2)),
        drained_s=draw(st.sampled_from([None, None, None, 0.5, 5.0, 20.0])),
        unready_s=draw(st.floats(0.5, 1.0) | st.floats(300, 600)) if state == "unready" else None,
        outdated=draw(st.sampled_from([False, False, True])),
        price=draw(st.sampled_from([0.1, 0.2])),
        at_risk=draw(st.sampled_from([False, False, True])),
        disagrees=draw(st.sampled_from([False, False, False, True])),
        of=of,
    )


@st.composite
def worlds(draw: st.DrawFn, *, links_known: bool | None = None) -> World:
    """Any world: consistent in its parts, and in nothing else."""
    asked = spec(
        draw(st.integers(1, 4)),
        max_surge=draw(st.integers(0, 2)),
        max_usd_per_hour=draw(st.sampled_from([None, None, 0.3, 0.5, 1.0])),
        on_demand=OnDemandSpec(0, fallback=draw(st.booleans())),
        spread=draw(st.sampled_from(Spread)),
    )
    mixed = asked.on_demand.fallback
    slots = st.sampled_from([*range(6), *range(STAND_INS, STAND_INS + 3 * mixed)])
    ids = draw(st.lists(st.tuples(slots, st.integers(1, 3)), unique=True, min_size=0, max_size=7))
    sold = (*OFFERS, *ON_DEMAND) if mixed else OFFERS
    world = World(asked, offers=tuple(draw(st.lists(st.sampled_from(sold), unique=True))))
    world = world.having(*(draw(parts(asked, slot, generation)) for slot, generation in ids))
    known = draw(st.booleans()) if links_known is None else links_known
    ending = frozenset(
        draw(st.lists(st.sampled_from([m.id for m in world.machines or ()]), max_size=2))
        if ids
        else []
    )
    intent = Intent(
        target=draw(st.sampled_from([None, 1, 2, 3, 5])),
        scaled_from=asked.replicas,
        drained=draw(st.dictionaries(st.integers(0, 5), st.integers(1, 3), max_size=2)),
        excluded=frozenset(
            draw(st.lists(st.sampled_from(["east/one/a", "east/one", "west"]), max_size=1))
        ),
    )
    failures = draw(st.lists(st.sampled_from(PLACES), max_size=3))
    past = [
        Event(
            NOW - draw(st.floats(1, 4000)),
            kind,
            9,
            index + 1,
            place.location,
            Reason(Cause.CAPACITY),
        )
        for index, place in enumerate(failures)
        for kind in (EventKind.LAUNCH, EventKind.REFUSED)
    ]
    losses = draw(st.sampled_from([0, 0, 5]))  # so many within the hour
    past += [
        Event(NOW - 600.0 * n, kind, 8, 9 - n, PLACES[n % 4].location)
        for n in range(1, 1 + losses)
        for kind in (EventKind.LAUNCH, EventKind.READY, EventKind.GONE)
    ]
    foreign = replace(
        replica(draw(st.integers(0, 2)), of=asked).machine, id=ReplicaId(STRANGER, 0, 1)
    )
    return replace(
        world,
        machines=(*(world.machines or ()), foreign),
        links=world.links if known else None,
        events=tuple(sorted((*world.events, *past), key=_at)),
        intent=intent,
        ending=ending,
    )


def serving(world: World) -> set[ReplicaId]:
    """Whom the links call ready."""
    return {link.id for link in world.links or () if link.ready}


def counted(world: World, machines: Iterable[Machine]) -> list[Machine]:
    """Return the machines that law 1 counts: not noticed, failed, late or long silent."""
    links = {link.id: link for link in world.links or ()}
    health = world.spec.health

    def exempt(machine: Machine) -> bool:
        link = links.get(machine.id)
        record = world.history.record(machine.id.slot, machine.id.generation)
        never_ready = record is None or record.first_ready_at is None
        late = never_ready and world.now - machine.launched_at > health.start_limit_s
        silent = link is not None and link.silent_for_s > health.replace_after_s
        return machine.notice or machine.phase is MachinePhase.FAILED or silent or late

    return [m for m in machines if m.id.pool_uid == UID and not exempt(m)]


def shorts(ids: Sequence[ReplicaId] | Iterable[ReplicaId]) -> list[str]:
    return sorted(id.short for id in ids)
