"""On-demand machines that fill in while too few spot machines are ready. Pure.

Where a group has `fallback`, on-demand machines in slots of their own stand in, ordered beside
another spot machine. What counts is readiness, not whether every location refused. While an
on-demand machine serves, which nobody takes away, spot is asked for alone, and another one stands
in only once that was refused. Nor is a slot short whose first machine is still booting.

Not here: where they are bought (`buying`) and the two steps of an ending (`endings`).
"""

from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

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


class Part(NamedTuple):
    """A group's share of what is wanted and of the machines."""

    group: Group
    wanted: int
    others: Classification  # its machines but for `standing_in`
    standing_in: Sequence[Assessment]
    held: int  # so many of those that stand in are kept in place of spot machines
    surge: int  # so many more stand-ins boot while nobody serves


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


def is_first(slot: int, generation: int, history: History, *, safe: bool) -> bool:
    """Whether a spot machine is the first of its slot, or the first since that last served."""
    return generation == (history.served[slot] if safe else 0) + 1


def missing(part: Part, begun: int, history: History, *, safe: bool) -> int:
    """Return how many more stand-ins a group needs.

    So many of its slots get their first machine now (`begun`); one serves that is not preempted
    (`safe`).
    """
    wanted, kept = part.wanted - begun, (*part.others.good, *part.others.replaced)
    standing_in = [s for s in part.standing_in if not s.unwanted]
    covered = sum(
        s.ever_ready or is_first(s.slot, s.id.generation, history, safe=safe) for s in kept
    )
    racing = _racing(part, wanted, standing_in) if history.served and not covered else 0
    return wanted + racing - covered - len(standing_in)


def surplus(part: Part, now: float) -> int:
    """Return how many stand-ins are no longer needed, given enough others that have settled.

    Beside one that is held, and serves, a spot machine needs no time to settle.
    """
    settled_s = 0.0 if part.held and any(s.serving for s in part.standing_in) else SETTLED_S
    others = (*part.others.good, *part.others.replaced)
    settled = sum(s.serving and s.was_ready_for(settled_s, now) for s in others)
    kept = sum(not s.unwanted for s in part.standing_in)
    racing = 0 if settled else _racing(part, part.wanted, part.standing_in)
    return kept - max(0, part.wanted + racing - settled)


def _racing(part: Part, wanted: int, standing_in: Sequence[Assessment]) -> int:
    """Return how many more boot where none serves yet: of many at once the fastest decides."""
    if part.group.on_demand.standbys >= part.wanted or any(s.serving for s in standing_in):
        return 0  # stopped standbys start sooner
    return min(part.surge, 2 * wanted - 1)
