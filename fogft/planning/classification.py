"""Sort every machine into what it is to the pool: kept, to be replaced, or lost. Pure.

Owns: why a working replica is not wanted as it is.
Not here: health (`health`), and moving those that could be better placed (`migration`).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from fogft.model.groups import BLOCK, replica_hash
from fogft.model.intent import Intent
from fogft.model.reason import Cause, Reason
from fogft.model.replica import MachinePhase, Observed
from fogft.model.spec import PoolSpec
from fogft.planning.endings import Census, Standing, is_outdated
from fogft.planning.needs import part
from fogft.planning.observed.health import Health, Verdict
from fogft.planning.sizing import Size

_ORDER = {Cause.DRAINED: 0, Cause.EXCLUDED: 1, Cause.OUTDATED: 3}  # all others between
_LOST = (Verdict.LEAVING, Verdict.UNRESPONSIVE)
_DOUBTED = (Verdict.STUCK, Verdict.AT_RISK, Verdict.DISAGREES)


def take_census(
    spec: PoolSpec,
    intent: Intent,
    observed: Observed,
    *,
    health: Health,
    size: Size,
) -> Census:
    """Sort every machine of the pool."""
    census = Census()
    failed = Verdict.FAILED
    blocks = {group.block for group in size.groups}
    for judged in health.replicas:
        standing, verdict = Standing(judged), judged.verdict
        if observed.ending and standing.id in observed.ending:
            census.ending.append(standing)
        elif verdict is failed:
            census.failed.append(standing)
        elif verdict in _LOST:
            census.lost.append(standing)
        elif why := _unwanted(spec, intent, standing, blocks):
            standing.reason = why
            if _is_young(standing, health) or _never_served(standing, health):
                census.aborted.append(standing)
            else:
                census.replaced.append(standing)
        else:
            census.good.append(standing)
    _supersede(census, health, size)
    census.replaced.sort(key=lambda s: (_rank(s), s.id))
    census.lost.sort(key=lambda s: (s.verdict is not Verdict.LEAVING, s.id))
    return census


def _supersede(census: Census, health: Health, size: Size) -> None:
    """Of two good ones in one slot the older goes, where there is one too many.

    So a replica that moves is ended when its successor serves, and not the other way round.
    """
    newest = {s.slot: s.id.generation for s in census.good}  # in the order of generations
    if len(newest) == len(census.good):
        return
    for group, wanted in zip(size.groups, size.counts, strict=True):
        here = part(census, size.groups, group)
        surplus = len(here.good) + len(here.replaced) - wanted
        old = [s for s in here.good if s.id.generation < newest[s.slot]]
        for standing in old[: max(0, surplus)]:
            census.good.remove(standing)
            why = Reason(Cause.SUPERSEDED, replica=f"{standing.slot}.{newest[standing.slot]}")
            young = _is_young(standing, health)
            goes = replace(standing, reason=why)
            (census.aborted if young else census.replaced).append(goes)


def _unwanted(
    spec: PoolSpec, intent: Intent, standing: Standing, blocks: Collection[int]
) -> Reason | None:
    """Return why a working replica is to be replaced; None when it is not."""
    machine, slot = standing.judged.machine, standing.slot
    if intent.drained and intent.is_drained(slot, standing.id.generation):
        return Reason(Cause.DRAINED)
    if intent.excluded and intent.is_excluded(machine.placement.location):
        return Reason(Cause.EXCLUDED, location=machine.placement.location)
    if standing.verdict in _DOUBTED:
        return standing.judged.why
    if slot // BLOCK not in blocks:
        return Reason(Cause.NO_GROUP)
    if machine.spec_hash != replica_hash(spec, slot):
        return Reason(Cause.OUTDATED)
    return None


def _rank(standing: Standing) -> int:
    why = standing.why
    return 2 if why is None else _ORDER.get(why.cause, 2)


def _is_young(standing: Standing, health: Health) -> bool:
    """Whether it certainly never served, so that it can be ended at once."""
    if standing.judged.machine.phase is MachinePhase.PROVISIONING:
        return True
    known = health.links_known and not health.uplink_suspected
    return known and not standing.ever_ready and not standing.answers


def _never_served(standing: Standing, health: Health) -> bool:
    """Whether an outdated one answers probes and has never had a service ready: it is no loss."""
    known = health.links_known and not health.uplink_suspected
    link = standing.judged.link
    served = standing.ever_ready or (link is not None and bool(link.ready))
    return known and not served and is_outdated(standing)
