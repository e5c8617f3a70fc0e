"""On-demand machines that are stopped when spot is back, and started when it is lost again. Pure.

The planner does not know of them: afterwards, a planned end becomes a stop, and a planned launch
becomes a start, where the effect on the plan is the same.

Not here: who stands in, and when (`fallback`).
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

from fogft.model.groups import group_of, groups_of, is_current, is_stand_in
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Observed, Offer, ReplicaId
from fogft.model.spec import PoolSpec
from fogft.planning.buying import PlannedLaunch
from fogft.planning.planner import PlannedEnd
from fogft.planning.sizing import Inputs


def started(
    inputs: Inputs, launches: Iterable[PlannedLaunch], slack_usd: float | None = None
) -> Mapping[int, PlannedLaunch]:
    """Return, by the slot of a planned stand-in, the standby to start in its place.

    It may have an instance type other than the planned one if all types of a location cost about
    the same. It may cost `slack_usd` an hour more than the planned machine; None for any amount.
    """
    spec, intent, observed, _ = inputs
    groups = groups_of(spec)
    prices = {(o.group, o.placement.supply): o for o in observed.offers}
    left = [m for m in observed.standbys if m.id not in observed.ending and is_current(spec, m)]
    found: dict[int, PlannedLaunch] = {}
    for planned in launches:
        if not is_stand_in(planned.slot):
            continue
        group = group_of(groups, planned.slot)
        for machine in left:
            offer, place = prices.get((group.name, machine.placement.supply)), machine.placement
            suits = group.owns(machine.id.slot) and not intent.is_excluded(place.location)
            if offer is None or not suits:
                continue
            if slack_usd is None or offer.usd_per_hour <= planned.offer.usd_per_hour + slack_usd:
                left.remove(machine)
                id, offer = machine.id, replace(offer, placement=place)
                found[planned.slot] = PlannedLaunch(id.slot, id.generation, offer, planned.reason)
                break
    return found


def stopped(
    spec: PoolSpec, ends: Iterable[PlannedEnd], observed: Observed
) -> Mapping[ReplicaId, PlannedLaunch]:
    """Return the machines to stop rather than end, because enough spot machines are back."""
    groups = groups_of(spec)
    machines = {machine.id: machine for machine in observed.machines or ()}
    room = {
        group.name: group.on_demand.standbys - sum(group.owns(m.id.slot) for m in observed.standbys)
        for group in groups
    }
    found: dict[ReplicaId, PlannedLaunch] = {}
    for end in ends:
        machine, group = machines.get(end.id), group_of(groups, end.id.slot)
        enough = end.reason.cause is Cause.ENOUGH_SPOT and not (machine and machine.placement.spot)
        if machine is not None and enough and room[group.name] > 0 and is_current(spec, machine):
            room[group.name] -= 1
            offer = Offer(machine.placement, machine.usd_per_hour)
            found[end.id] = PlannedLaunch(end.id.slot, end.id.generation, offer, end.reason)
    return found


def superfluous(
    spec: PoolSpec, observed: Observed, starting: Iterable[PlannedLaunch], *, stopping: bool = False
) -> list[tuple[ReplicaId, Reason]]:
    """Return the standbys to end: of another version, or more than the file asks for."""
    groups = groups_of(spec)
    used = {(planned.slot, planned.generation) for planned in starting}
    room = {group.name: 0 if stopping else group.on_demand.standbys for group in groups}
    ends = []
    for machine in observed.standbys:
        if machine.id in observed.ending or (machine.id.slot, machine.id.generation) in used:
            continue
        group = group_of(groups, machine.id.slot)
        room[group.name] -= 1
        if not is_current(spec, machine):
            ends.append((machine.id, Reason(Cause.OUTDATED)))
        elif room[group.name] < 0:
            ends.append((machine.id, Reason(Cause.NOT_WANTED)))
    return ends
