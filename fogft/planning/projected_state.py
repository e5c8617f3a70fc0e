"""The state of a pool with a plan's launches, endings and marks already applied. Pure.

It is what the manager will observe at its next tick if nothing else happens. The planner plans on
it again, so that one plan holds all that follows from itself.

Owns: how a plan changes what is observed and remembered.
Not here: what is decided (`planner`) and what is really done (`fogft.pool.manager.reconciler`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from fogft.model.groups import replica_hash
from fogft.model.replica import Machine, MachinePhase, Observed, ReplicaId
from fogft.model.spec import PoolSpec
from fogft.planning.buying import PlannedLaunch
from fogft.planning.observed.history import Event, EventKind, History


def projected_state(
    pool_uid: str,
    spec: PoolSpec,
    observed: Observed,
    history: History,
    *,
    launches: Sequence[PlannedLaunch],
    ends: Collection[ReplicaId],
    draining: Collection[ReplicaId],
) -> tuple[Observed, History]:
    """Return the observation and history with launches, endings and marks applied."""
    now = observed.now
    ordered = [_ordered(pool_uid, spec, launch, now) for launch in launches]
    events = [
        Event(
            now,
            EventKind.LAUNCH,
            machine.id.slot,
            machine.id.generation,
            machine.placement.location,
            on_demand=not machine.placement.spot,
        )
        for machine in ordered
    ]
    marked = {(r.slot, r.generation) for r in history.open() if r.draining_since is not None}
    events += [
        Event(now, EventKind.DRAINING, id.slot, id.generation)
        for id in draining
        if (id.slot, id.generation) not in marked
    ]
    later = replace(
        observed,
        machines=(*(observed.machines or ()), *ordered),
        ending=observed.ending.union(ends),
    )
    return later, history.followed_by(events) if events else history


def _ordered(pool_uid: str, spec: PoolSpec, launch: PlannedLaunch, now: float) -> Machine:
    return Machine(
        id=ReplicaId(pool_uid, launch.slot, launch.generation),
        placement=launch.offer.placement,
        phase=MachinePhase.PROVISIONING,
        launched_at=now,
        usd_per_hour=launch.offer.usd_per_hour,
        spec_hash=replica_hash(spec, launch.slot),
    )
