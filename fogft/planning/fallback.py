"""On-demand machines that fill in while too few spot machines are ready. Pure.

Where a group has `fallback`, on-demand machines in slots of their own stand in, ordered beside
another spot machine. What counts is readiness, not whether every location refused. While an
on-demand machine serves, which nobody takes away, spot is asked for alone, and another one stands
in only once that was refused. Nor is a slot short whose first machine is still booting.

Not here: where they are bought (`buying`) and the two steps of an ending (`endings`).
"""

from bisect import bisect_right
from collections.abc import Sequence

from fogft.model.groups import Group
from fogft.planning.classification import Classification
from fogft.planning.observed.health import Assessment
from fogft.planning.observed.history import History

# Longer would cost more than the few losses that it bridges: others serve.
SETTLED_S = 20.0
# Under a cap that has no room for both, a stand-in makes way for a spot machine after so long.
STAYS_S = 600.0
# Where so many spot machines were lost within so long, one is on demand: losses come in clusters,
# and without one all that are left may go at once.
OFTEN = 2
OFTEN_S = 1800.0


def held(
    group: Group, wanted: int, standing_in: Sequence[Assessment], history: History, now: float
) -> int:
    """Return how many of a group's stand-ins replace spot machines, for which no search is made.

    None in place of a lone one: that would be to give up spot machines.
    """
    spot = wanted - group.on_demand.base
    if not group.on_demand.fallback or spot < 2:
        return 0
    return int(bool(standing_in) and len(losses_of_late(history, now)) >= OFTEN)


def losses_of_late(history: History, now: float) -> list[float]:
    """Return the times of the losses that `held` counts."""
    return [
        at
        for losses in history.losses.values()
        for at in losses[bisect_right(losses, now - OFTEN_S) : bisect_right(losses, now)]
    ]


def surge_of(group: Group, wanted: int, surge: int) -> int:
    """Return how many more boot while nobody serves: none where stopped standbys start sooner."""
    return 0 if group.on_demand.standbys >= wanted else surge


def is_first(slot: int, generation: int, history: History, *, safe: bool) -> bool:
    """Whether a spot machine is the first of its slot, or the first since that last served."""
    return generation == (history.served(slot) if safe else 0) + 1


def missing(
    wanted: int,
    here: Classification,
    standing_in: Sequence[Assessment],
    history: History,
    *,
    surge: int,
    safe: bool,
) -> int:
    """Return how many more stand-ins a group needs; `safe`: one serves that is not preempted."""
    kept = (*here.good, *here.replaced)
    covered = sum(
        s.ever_ready or is_first(s.slot, s.id.generation, history, safe=safe) for s in kept
    )
    ever_served = any(map(history.served, history.generations))
    racing = _racing(wanted, surge, standing_in) if ever_served and not covered else 0
    return wanted + racing - covered - len(standing_in)


def spare(
    wanted: int,
    here: Classification,
    standing_in: Sequence[Assessment],
    now: float,
    *,
    surge: int,
    held: int = 0,
) -> int:
    """Return how many stand-ins are no longer needed, given enough others that have settled.

    Beside one that is held, and serves, a spot machine needs no time to settle.
    """
    settled_s = 0.0 if held and any(s.serving for s in standing_in) else SETTLED_S
    settled = sum(has_served(s, settled_s, now) for s in (*here.good, *here.replaced))
    kept = sum(not s.unwanted for s in standing_in)
    racing = 0 if settled else _racing(wanted, surge, standing_in)
    return kept - max(0, wanted + racing - settled)


def _racing(wanted: int, surge: int, standing_in: Sequence[Assessment]) -> int:
    """Return how many more boot where none serves yet: of many at once the fastest decides."""
    return 0 if any(s.serving for s in standing_in) else min(surge, 2 * wanted - 1)


def has_served(replica: Assessment, for_s: float, now: float) -> bool:
    """Whether a replica serves, and was first ready at least this long ago."""
    return replica.serving and replica.was_ready_for(for_s, now)
