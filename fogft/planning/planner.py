"""Decide how a pool should change. Pure: no clock, no cloud, no randomness.

The reconciler observes, calls `plan` and applies the result. The decision depends on the arguments
alone, so planning again after a crash is always safe. This module orders the steps and keeps the
pool within its cap. docs/design/planner.md shows the flow.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from fogft.model.groups import group_of, is_stand_in, replica_hash
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Machine, MachinePhase, ReplicaId
from fogft.planning import fallback, migration, rollout
from fogft.planning.buying import Buyer, PlannedLaunch
from fogft.planning.classification import classify
from fogft.planning.endings import Endings, choose_endings
from fogft.planning.needs import Need, needed_launches, stand_in
from fogft.planning.observed.health import Assessment, Health, Verdict, judge
from fogft.planning.observed.history import Event, EventKind, History
from fogft.planning.placement import EPSILON_USD
from fogft.planning.sizing import Inputs, size

__all__ = ["Plan", "PlannedEnd", "PlannedLaunch", "plan"]

# The most times that a plan is extended; two passes are nearly always enough.
MOST_PASSES = 8


class PlannedEnd(NamedTuple):
    """A machine to end, and why."""

    id: ReplicaId
    reason: Reason


class Plan(NamedTuple):
    """A plan: launches, endings, marks and notes."""

    wanted: int  # how many replicas should be ready
    launches: tuple[PlannedLaunch, ...] = ()
    terminations: tuple[PlannedEnd, ...] = ()
    # Replicas to mark as draining in the membership; they end a little later.
    draining: tuple[ReplicaId, ...] = ()
    notes: tuple[Reason, ...] = ()  # why the pool is not yet as wanted
    health: Health | None = None  # what the plan was based on; None if the cloud did not answer
    # It is certain, without another pass, that planning on from here adds nothing.
    closed: bool = False
    # A needed launch, or a stand-in's return, waits for a location's backoff to end.
    waits: bool = False
    # Replicas that would move if they had stayed long enough and no location backed off.
    restless: frozenset[ReplicaId] = frozenset()


def plan(pool_uid: str, inputs: Inputs, *, health: Health | None = None) -> Plan:
    """Plan changes that bring the pool closer to its spec, within the safety rules.

    Planning repeats on the state that follows from the plan so far, until nothing is added.
    `health` is the result of `judge` for the same inputs, if it is already known.
    """
    health = health or judge(pool_uid, inputs.spec, inputs.observed, inputs.history)
    decided = latest = plan_once(inputs, health)
    for _ in range(MOST_PASSES):
        changes = latest.launches or latest.terminations or _newly_marked(latest, inputs.history)
        if latest.closed or not changes:
            break
        later = _under_way(pool_uid, inputs, decided)
        health = judge(pool_uid, later.spec, later.observed, later.history)
        latest = plan_once(later, health)
        is_done = not latest.launches and not latest.terminations
        is_done = is_done and set(latest.draining) == set(decided.draining)
        decided = decided._replace(
            launches=decided.launches + latest.launches,
            terminations=decided.terminations + latest.terminations,
            draining=latest.draining,
            notes=tuple(dict.fromkeys(decided.notes + latest.notes)),
            waits=decided.waits or latest.waits,
            restless=decided.restless | latest.restless,
        )
        if is_done:
            break
    return decided


def _newly_marked(decided: Plan, history: History) -> list[ReplicaId]:
    marked = {(r.slot, r.generation) for r in history.open() if r.draining_since is not None}
    return [id for id in decided.draining if (id.slot, id.generation) not in marked]


def _under_way(pool_uid: str, inputs: Inputs, decided: Plan) -> Inputs:
    """Return the observation and history that result if only the plan happens."""
    spec, _, observed, history = inputs
    now = observed.now
    ordered, events = [], []
    for slot, generation, offer, _ in decided.launches:
        ordered.append(
            Machine(
                id=ReplicaId(pool_uid, slot, generation),
                placement=offer.placement,
                phase=MachinePhase.PROVISIONING,
                launched_at=now,
                usd_per_hour=offer.usd_per_hour,
                spec_hash=replica_hash(spec, slot),
            )
        )
        place, on_demand = offer.placement.location, not offer.placement.spot
        events.append(Event(now, EventKind.LAUNCH, slot, generation, place, on_demand=on_demand))
    for id in _newly_marked(decided, history):
        events.append(Event(now, EventKind.DRAINING, id.slot, id.generation))
    later = replace(
        observed,
        machines=(*(observed.machines or ()), *ordered),
        ending=observed.ending.union(end.id for end in decided.terminations),
    )
    history = history.followed_by(events) if events else history
    return inputs._replace(observed=later, history=history)


def plan_once(inputs: Inputs, health: Health) -> Plan:
    spec, intent, observed, history = inputs
    if observed.machines is None:
        known = size(inputs).total if observed.offers else intent.wanted(spec, observed.wall_clock)
        return Plan(known, notes=(Reason(Cause.CLOUD_UNREACHABLE),))
    if intent.stopping:
        left = [judged.id for judged in health.replicas if judged.id not in observed.ending]
        ends = [PlannedEnd(id, Reason(Cause.DOWN)) for id in left]
        return Plan(0, terminations=tuple(ends), notes=(Reason(Cause.STOPPING),), health=health)

    sized = size(inputs, sum(s.verdict is not Verdict.FAILED for s in health.replicas))
    machines = classify(inputs, health, sized)
    standing_in = [s for s in (*machines.good, *machines.replaced) if is_stand_in(s.slot)]
    others = machines.without(standing_in) if standing_in else machines
    buyer = Buyer(inputs, machines, sized, standing_in)
    counts, excess = _within_cap(buyer)
    wanted = sum(counts)
    settling = bool(others.replaced) and rollout.is_settling(others, observed.now)
    of_groups = [
        [s for s in standing_in if group_of(sized.groups, s.slot) is group]
        for group in sized.groups
    ]
    held = [
        fallback.held(group, count, mine, history, observed.now)
        for group, count, mine in zip(sized.groups, counts, of_groups, strict=True)
    ]
    sought = [count - kept for count, kept in zip(counts, held, strict=True)]
    needs = needed_launches(sized.groups, sought, others, history, settling=settling)
    may_move = not needs and not standing_in and len(machines.good) == wanted and spec.max_surge > 0
    waits = False
    is_quiet = may_move and migration.is_quiet(machines, health)
    restless = migration.restless(buyer) if is_quiet else frozenset()
    found = migration.mover(buyer, observed.now, restless) if restless else None
    if found is not None:
        machines.good.remove(found.replica)
        machines.replaced.append(found.replica._replace(unwanted=found.why))
        needs = needed_launches(sized.groups, counts, machines, history)
    room = wanted + spec.max_surge - machines.live
    first: Assessment | None = None
    safe = any(
        (s.ever_ready if health.uplink_suspected else s.serving) and not s.placement.spot
        for s in (*machines.good, *machines.replaced)
    )
    begun = [
        need
        for need in needs
        if fallback.is_first(need.slot, buyer.next_generation(need.slot), history, safe=safe)
    ]
    parts = [
        fallback.Part(group, count, others.part(sized.groups, group), mine, kept, spec.max_surge)
        for group, count, mine, kept in zip(sized.groups, counts, of_groups, held, strict=True)
    ]
    kept_free = _urgent_first(buyer, _stand_ins_missing(parts, begun, history, safe), room)
    for need in needs:
        if not buyer.buy(need, room=room - kept_free):
            first = _first_to_go(need, buyer, wanted, spec.max_surge)
            first = first or _stand_in_to_go(need, buyer, wanted, room)
            waits = True
            break
    ordered = {launch.slot for launch in buyer.launches}
    begun = [need for need in begun if need.slot in ordered]
    for need in _stand_ins_missing(parts, begun, history, safe):
        if need.slot not in ordered:
            buyer.buy(need, room=room)
    outdated = [s.id for s in others.replaced if s.is_outdated and not s.draining_since]
    endings = Endings()
    # Each group by itself: a surplus in one does not fill in for another.
    for part in parts:
        makes_room = first is not None and group_of(sized.groups, first.slot) is part.group
        choose_endings(
            part,
            health,
            history,
            endings,
            now=observed.now,
            dear_first=bool(excess),
            held=outdated if settling else (),
            first=first if makes_room else None,
        )
    going = [
        *((s, s.why or Reason(Cause.NOT_WANTED)) for s in (*machines.failed, *machines.aborted)),
        *endings.now,
        *((s, why) for s, why in buyer.ended_for_room if s.id not in endings.ids),
    ]
    notes = [*sized.notes, *excess, *buyer.notes, *endings.notes]
    if health.uplink_suspected:
        notes.insert(0, Reason(Cause.UPLINK_SUSPECTED))
    return Plan(
        wanted=wanted,
        launches=tuple(buyer.launches),
        terminations=tuple(PlannedEnd(s.id, why) for s, why in going),
        draining=tuple(s.id for s in endings.draining),
        notes=tuple(dict.fromkeys(notes)),
        health=health,
        # Launches alone, if no machine is to end, give the next pass nothing new to decide.
        # A replica that moves ends only once its successor serves: all others serve and are needed.
        # Room that was kept for stand-ins, but not used by them, is left for the next pass.
        closed=not (going or endings.draining or machines.ending or excess)
        and (found is not None or not machines.replaced)
        and not (kept_free and waits),
        waits=waits,
        restless=restless,
    )


def _urgent_first(buyer: Buyer, short: Sequence[Need], room: int) -> int:
    """Order stand-ins first if no replica serves; return how much room is kept for them.

    While a replica serves, that is room for one. Otherwise spot, which may be refused and boots no
    faster, gets the rest; under a cap spot comes first, as one expensive machine might use it up.
    """
    serves = any(s.may_serve for s in (*buyer.machines.good, *buyer.machines.replaced))
    if buyer.cap is None and not serves:
        for need in short:
            buyer.buy(need, room=room)
        return 0
    most = 1 if serves else len(short)
    return 0 if buyer.standing_in else max(0, min(most, len(short), room - 1))


def _stand_ins_missing(
    parts: Sequence[fallback.Part], begun: Sequence[Need], history: History, safe: bool
) -> list[Need]:
    """Return the stand-ins needed; the slots of `begun` get their first machine now."""
    needs: list[Need] = []
    for part in parts:
        if not part.group.on_demand.fallback:
            continue
        used = {s.slot for s in (*part.others.everyone(), *part.standing_in)}
        first = sum(need.group is part.group for need in begun)
        for _ in range(fallback.missing(part, first, history, safe=safe)):
            needs.append(stand_in(part.group, used))
            used.add(needs[-1].slot)
    return needs


def _first_to_go(need: Need, buyer: Buyer, wanted: int, max_surge: int) -> Assessment | None:
    """Return the outdated replica that must, and may, end before its successor is launched."""
    old = need.replaces
    if old is None or not old.is_outdated or old not in buyer.machines.replaced:
        return None
    fits = buyer.fits_instead(need, old)
    if not fits or (max_surge and buyer.fits_beside(need)):
        return None
    if not rollout.may_go_first(old, buyer.machines, wanted):
        buyer.notes.append(Reason(Cause.NO_ROOM_TO_UPDATE, slot=need.slot))
        return None
    buyer.notes.append(Reason(Cause.OLD_BEFORE_NEW, slot=need.slot))
    return old


def _stand_in_to_go(need: Need, buyer: Buyer, wanted: int, room: int) -> Assessment | None:
    """Return the stand-in that makes room under the cap for a spot machine, if one may.

    It may if all other wanted replicas serve and it was first ready `fallback.STAYS_S` ago. If no
    spot machine can be launched, it is ordered again.
    """
    if buyer.cap is None:
        return None
    machines = buyer.machines
    if room <= len(buyer.launches) or buyer.launches or machines.ending or buyer.fits_beside(need):
        return None
    working = (*machines.good, *machines.replaced)
    serving = sum(s.serving for s in working)
    if serving != len(working) or serving < max(2, wanted):
        return None
    for replica in buyer.standing_in:
        here = group_of(buyer.groups, replica.slot) is need.group
        stayed = here and replica.was_ready_for(fallback.STAYS_S, buyer.observed.now)
        if stayed and buyer.fits_instead(need, replica):
            buyer.notes.append(Reason(Cause.OLD_BEFORE_NEW, slot=need.slot))
            return replica
    return None


def _within_cap(buyer: Buyer) -> tuple[Sequence[int], list[Reason]]:
    """Return the wanted number of each group: one fewer while the good replicas exceed the cap.

    This is for a cap that was lowered: no launch exceeds it. A price rise since the order does not
    count; a price drop does, as more were launched because of it. One replica always stays.
    """
    machines = buyer.machines
    cap, counts, groups = buyer.cap, list(buyer.sized.counts), buyer.groups
    if cap is None or len(machines.good) < 2:
        return counts, []
    cost = sum(min(s.machine.usd_per_hour, buyer.price(s)) for s in machines.good)
    if cost <= cap + EPSILON_USD:
        return counts, []
    if machines.replaced or machines.ending or len(machines.good) > sum(counts):
        return counts, []  # it is shrinking already
    index = max(i for i, group in enumerate(groups) if machines.part(groups, group).good)
    counts[index] = min(counts[index], len(machines.part(groups, groups[index]).good) - 1)
    return counts, [Reason(Cause.OVER_CAP, usd_per_hour=cost, limit_usd_per_hour=cap)]
