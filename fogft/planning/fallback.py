"""On-demand machines beside the search for spot ones, while too few are ready. Pure.

What counts is readiness: whether enough replicas serve, not whether every location refused.
Where a group has `fallback`, on-demand machines in slots of their own stand in. They are ordered
the moment that a spot replica is lost, is noticed or is refused, beside the order of
another spot machine, and end once enough others have been ready for `SETTLED_S`.

A slot whose first machine is still booting is not short of anything: nothing was lost.

Owns: who stands in, and how many are missing.
Not here: where they are bought (`buying`) and the two steps of an ending (`endings`).
"""

from __future__ import annotations

from collections.abc import Sequence

from fogft.model.groups import is_stand_in
from fogft.planning.classification import Classification
from fogft.planning.observed.health import Assessment

# A quarter of all losses come within minutes of the order.
SETTLED_S = 60.0
# Under a cap that has no room for both, a stand-in makes way for a spot machine after so long.
STAYS_S = 600.0


def stand_ins(machines: Classification) -> list[Assessment]:
    """Return the machines that stand in for others, and are not lost."""
    return [s for s in (*machines.good, *machines.replaced) if is_stand_in(s.slot)]


def missing(wanted: int, here: Classification, standing_in: Sequence[Assessment]) -> int:
    """Return how many more stand-ins are called for.

    Args:
        wanted: How many replicas should be ready.
        here: The group's machines, without its stand-ins.
        standing_in: Its stand-ins, booting ones included.
    """
    kept = (*here.good, *here.replaced)
    ready = sum(s.ever_ready for s in kept)
    first = sum(not s.ever_ready and s.id.generation == 1 for s in kept)
    return wanted - ready - first - len(standing_in)


def spare(wanted: int, here: Classification, standing_in: Sequence[Assessment], now: float) -> int:
    """Return how many stand-ins are no longer needed, given enough others that have settled."""
    settled = sum(_is_settled(s, now) for s in (*here.good, *here.replaced))
    kept = sum(not s.unwanted for s in standing_in)
    return kept - max(0, wanted - settled)


def has_stayed(replica: Assessment, now: float) -> bool:
    """Whether a stand-in may make way for a spot machine that the cap has no room for besides."""
    return _has_served(replica, STAYS_S, now)


def _is_settled(replica: Assessment, now: float) -> bool:
    return _has_served(replica, SETTLED_S, now)


def _has_served(replica: Assessment, for_s: float, now: float) -> bool:
    record = replica.record
    if not replica.serving or record is None or record.first_ready_at is None:
        return False
    return now - record.first_ready_at >= for_s
