"""Decide how a pool should change. Pure: no clock, no cloud, no randomness.

The reconciler observes, calls `plan` and applies the result. All that the decision
depends on is an argument, so a bug report that quotes the arguments is a failing test,
and planning again after a crash is always safe. docs/design/planner.md has the flow.

Owns: how many machines are missing, in which slot, and who is replaced.
Not here: where a launch goes (`placement`), who ends (`endings`), who is ill (`health`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field

from fogft.core.endings import Census, Standing, choose_endings
from fogft.core.health import Health, Judged, Verdict, judge
from fogft.core.history import History
from fogft.core.intent import Intent
from fogft.core.model import MachinePhase, Observed, Offer, Placement, ReplicaId
from fogft.core.placement import Choice, choose
from fogft.core.quarantine import resting
from fogft.core.spec import PoolSpec

AVOID_S = 300.0  # a location where a replica was just lost is used only when no other is left
DRAIN_LIMIT_S = 10.0


@dataclass(frozen=True)
class PlannedLaunch:
    """Order a machine for a slot, under a generation never used before."""

    slot: int
    generation: int
    offer: Offer
    reason: str


@dataclass(frozen=True)
class PlannedEnd:
    """End a machine."""

    id: ReplicaId
    reason: str


@dataclass(frozen=True)
class Plan:
    """What to do now, and what is worth knowing.

    Attributes:
        draining: Replicas to mark as draining in the membership; they end a little later.
        notes: Why the pool is not yet as wanted, in sentences.
        wanted: How many replicas should be ready.
        health: What the plan was based on; None when the cloud could not tell.
    """

    wanted: int
    launches: tuple[PlannedLaunch, ...] = ()
    terminations: tuple[PlannedEnd, ...] = ()
    draining: tuple[ReplicaId, ...] = ()
    notes: tuple[str, ...] = ()
    health: Health | None = None


def plan(
    pool_uid: str,
    spec: PoolSpec,
    intent: Intent,
    observed: Observed,
    history: History,
    *,
    drain_limit_s: float = DRAIN_LIMIT_S,
) -> Plan:
    """Return what brings the pool closer to what is wanted, within the safety laws.

    Args:
        pool_uid: Machines of other pools are ignored.
        spec: The pool file.
        intent: What the user wants besides.
        observed: The world now, `observed.now` included.
        history: What happened before.
        drain_limit_s: The longest that a replica to be ended is waited for.
    """
    wanted = intent.wanted(spec)
    if observed.machines is None:
        return Plan(wanted, notes=("the cloud cannot be reached: nothing is changed",))
    health = judge(pool_uid, spec, observed, history)
    if intent.stopping:
        ends = [PlannedEnd(j.id, "down") for j in health.replicas if j.id not in observed.ending]
        return Plan(0, terminations=tuple(ends), notes=("stopping",), health=health)

    census = take_census(spec, intent, observed, history, health)
    buyer = _Buyer(spec, intent, observed, history, census)
    for need in needed_launches(wanted, census, history):
        if not buyer.buy(need, room=wanted + spec.max_surge - census.live):
            break
    endings = choose_endings(
        wanted, census, health, history, now=observed.now, drain_limit_s=drain_limit_s
    )
    ends = [PlannedEnd(s.id, s.why) for s in (*census.failed, *census.aborted)]
    ends += [PlannedEnd(s.id, why) for s, why in endings.now]
    ends += [PlannedEnd(s.id, why) for s, why in buyer.sacrificed if s.id not in endings.ids]
    notes = [*buyer.notes, *endings.notes]
    if health.uplink_suspected:
        notes.insert(0, "all links are silent together: the robot's uplink is suspected")
    return Plan(
        wanted=wanted,
        launches=tuple(buyer.launches),
        terminations=tuple(ends),
        draining=tuple(s.id for s in endings.draining),
        notes=tuple(dict.fromkeys(notes)),
        health=health,
    )


def take_census(
    spec: PoolSpec, intent: Intent, observed: Observed, history: History, health: Health
) -> Census:
    """Sort every machine into what it is to the pool: kept, to be replaced, or lost."""
    census = Census()
    for judged in health.replicas:
        record = history.record(judged.id.slot, judged.id.generation)
        standing = Standing(judged, record)
        if judged.id in observed.ending:
            census.ending.append(standing)
        elif judged.verdict is Verdict.FAILED:
            census.failed.append(standing)
        elif judged.verdict in (Verdict.LEAVING, Verdict.UNRESPONSIVE):
            census.lost.append(standing)
        elif why := _unwanted(spec, intent, judged):
            standing = Standing(judged, record, why)
            if _is_young(standing, health):
                census.aborted.append(standing)
            else:
                census.replaced.append(standing)
        else:
            census.good.append(standing)
    order = {"drained": 0, "excluded": 1, "outdated": 3}
    census.replaced.sort(key=lambda s: (order.get(s.why.split(" ")[0], 2), s.id))
    census.lost.sort(key=lambda s: (s.verdict is not Verdict.LEAVING, s.id))
    return census


def _unwanted(spec: PoolSpec, intent: Intent, judged: Judged) -> str:
    """Return why a working replica is to be replaced; empty when it is not."""
    machine = judged.machine
    if intent.is_drained(machine.id.slot, machine.id.generation):
        return "drained by the user"
    if intent.is_excluded(machine.placement.location):
        return f"excluded location {machine.placement.location}"
    if judged.verdict in (Verdict.STUCK, Verdict.AT_RISK):
        return judged.why
    if machine.spec_hash != spec.replica_hash:
        return "outdated by a change of the pool file"
    return ""


def _is_young(standing: Standing, health: Health) -> bool:
    """Whether it certainly never served, so that it can be ended at once."""
    if standing.judged.machine.phase is MachinePhase.PROVISIONING:
        return True
    known = health.links_known and not health.uplink_suspected
    return known and not standing.ever_ready and not standing.answers


@dataclass(frozen=True)
class Need:
    """One launch that is called for.

    Attributes:
        replaces: Whom it replaces; None to fill an empty slot.
    """

    slot: int
    reason: str
    replaces: Standing | None = None


def needed_launches(wanted: int, census: Census, history: History) -> Iterator[Need]:
    """Yield the launches called for: what is missing at once, replacements one at a time."""
    used = {s.slot for s in (*census.good, *census.replaced)}
    missing = wanted - len(census.good) - len(census.replaced)
    if missing > 0:
        vacant = [s for s in census.lost if s.slot not in used]
        lost_slots = {s.slot for s in vacant}
        for standing in vacant:
            if missing > 0 and standing.slot not in used:
                used.add(standing.slot)
                missing -= 1
                yield Need(standing.slot, f"replaces {standing.short}: {standing.why}", standing)
        used |= lost_slots
        for _ in range(missing):
            slot = _lowest_free(used)
            used.add(slot)
            yield Need(slot, _vacancy(slot, history))
        return
    one_is_coming = any(not s.ever_ready for s in census.good)
    if len(census.good) + len(census.replaced) > wanted or one_is_coming or census.ending:
        return
    for standing in census.replaced[:1]:
        # Its slot, unless a good one lives there already: that one then stands for another.
        taken = {s.slot for s in census.good}
        slot = standing.slot if standing.slot not in taken else _lowest_free(used)
        yield Need(slot, f"replaces {standing.short}: {standing.why}", standing)


def _lowest_free(used: set[int]) -> int:
    return next(slot for slot in itertools.count() if slot not in used)


def _vacancy(slot: int, history: History) -> str:
    generation = history.generation(slot)
    return f"follows {slot}.{generation}" if generation else "fills a new slot"


@dataclass
class _Buyer:
    """Turns needs into launches, within surge, budget and what is offered."""

    spec: PoolSpec
    intent: Intent
    observed: Observed
    history: History
    census: Census
    launches: list[PlannedLaunch] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    sacrificed: list[tuple[Standing, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._offered = {o.placement: o.usd_per_hour for o in self.observed.offers}
        self._spent = sum(self._price(s) for s in self.census.everyone())
        self._resting = resting(self.history, self.observed.now)

    def buy(self, need: Need, room: int) -> bool:
        """Plan one launch; False (and a note) when nothing more can be launched now."""
        if len(self.launches) >= room:
            verb = "replace" if need.replaces else "launch"
            self.notes.append(
                f"waiting to {verb} slot {need.slot}: `max_surge` allows no more machines now"
            )
            return False
        cap = self.spec.max_usd_per_hour
        choice = self._choose(need, None if cap is None else cap - self._spent)
        if choice.offer is None:
            self.notes.append(f"slot {need.slot} waits: {choice.why_not}")
            if cap is not None:
                self._make_room(need, cap)
            return False
        generation = self._next_generation(need.slot)
        self.launches.append(PlannedLaunch(need.slot, generation, choice.offer, need.reason))
        self._spent += choice.offer.usd_per_hour
        return True

    def _price(self, standing: Standing) -> float:
        """Return what a machine costs: as ordered, or more where its spot price has risen."""
        machine = standing.judged.machine
        return max(machine.usd_per_hour, self._offered.get(machine.placement, 0.0))

    def _choose(self, need: Need, budget: float | None) -> Choice:
        now = self.observed.now
        stay = [s for s in (*self.census.good, *self.census.replaced) if s is not need.replaces]
        taken: list[Placement] = [s.judged.machine.placement for s in stay]
        taken += [launch.offer.placement for launch in self.launches]
        avoid = {s.location for s in self.census.lost}
        if need.replaces is not None and not need.replaces.why.startswith("outdated"):
            avoid.add(need.replaces.location)
        offered = {o.placement.location for o in self.observed.offers}
        avoid |= {place for place in offered if now - self.history.lost_at(place) < AVOID_S}
        return choose(
            self.observed.offers,
            taken=taken,
            excluded=self.intent.excluded,
            resting=self._resting,
            avoid=avoid,
            budget_usd_per_hour=budget,
        )

    def _make_room(self, need: Need, cap: float) -> None:
        """Under a cap, a silent machine that blocks its own replacement goes first."""
        left = cap - self._spent + sum(self._price(s) for s in self.census.ending)
        if self._choose(need, left).offer is not None:
            return  # what is being ended already makes room enough
        for standing in self.census.lost:
            if standing.verdict is not Verdict.UNRESPONSIVE:
                continue
            if self._choose(need, left + self._price(standing)).offer is not None:
                self.sacrificed.append((standing, f"{standing.why}, and the budget has no room"))
                return

    def _next_generation(self, slot: int) -> int:
        listed = [s.id.generation for s in self.census.everyone() if s.slot == slot]
        known = [self.history.generation(slot), self.intent.drained.get(slot, 0)]
        return max([*known, *listed]) + 1
