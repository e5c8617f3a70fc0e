"""On-demand machines that fill in while too few spot machines are ready. Pure.

If a group has `fallback`, on-demand machines in slots of their own stand in, each ordered together
with another spot machine. Readiness decides, not whether every location refused. While an on-demand
machine serves, which cannot be preempted, only spot is ordered at first, and another stand-in only
once that was refused. A slot whose first machine is still booting needs no stand-in.

Not here: where stand-ins are bought (`buying`) and the two steps of an ending (`endings`).
"""

from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

from fogft.model.groups import Group
from fogft.planning.classification import Classification
from fogft.planning.observed.health import Assessment
from fogft.planning.observed.history import History

# A longer overlap would cost more than the few losses that it bridges: other replicas serve.
SETTLED_S = 20.0
# Under a cap without room for both, a stand-in makes way for a spot machine after this time.
STAYS_S = 600.0
# After OFTEN losses of spot machines within OFTEN_S, one on-demand machine is kept: losses come in
# clusters, and without it all remaining machines may be lost at once.
OFTEN = 2
OFTEN_S = 1800.0


class Part(NamedTuple):
    """The wanted number of replicas of one group, and its machines."""

    group: Group
    wanted: int
    others: Classification  # its machines except `standing_in`
    standing_in: Sequence[Assessment]
    held: int  # how many stand-ins are kept in place of spot machines
    surge: int  # how many extra stand-ins boot while no replica serves


def held(
    group: Group, wanted: int, standing_in: Sequence[Assessment], history: History, now: float
) -> int:
    """Return how many of a group's stand-ins are kept instead of looking for spot machines.

    0 if the group wants a single spot machine: keeping one would give up spot altogether.
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
    """Whether a generation is its slot's first or, if `safe`, the first since the slot served."""
    return generation == (history.served[slot] if safe else 0) + 1


def missing(part: Part, begun: int, history: History, *, safe: bool) -> int:
    """Return how many more stand-ins a group needs.

    `begun` is how many of its slots get their first machine now; `safe` means that a machine serves
    that cannot be preempted.
    """
    wanted, kept = part.wanted - begun, (*part.others.good, *part.others.replaced)
    standing_in = [s for s in part.standing_in if not s.unwanted]
    covered = sum(
        s.ever_ready or is_first(s.slot, s.id.generation, history, safe=safe) for s in kept
    )
    racing = _racing(part, wanted, standing_in) if history.served and not covered else 0
    return wanted + racing - covered - len(standing_in)


def surplus(part: Part, now: float) -> int:
    """Return how many stand-ins are no longer needed because enough other replicas have settled.

    While a stand-in is kept (`held`) and one serves, spot machines need no time to settle.
    """
    settled_s = 0.0 if part.held and any(s.serving for s in part.standing_in) else SETTLED_S
    others = (*part.others.good, *part.others.replaced)
    settled = sum(s.serving and s.was_ready_for(settled_s, now) for s in others)
    kept = sum(not s.unwanted for s in part.standing_in)
    racing = 0 if settled else _racing(part, part.wanted, part.standing_in)
    return kept - max(0, part.wanted + racing - settled)


def _racing(part: Part, wanted: int, standing_in: Sequence[Assessment]) -> int:
    """Return how many extra stand-ins boot while none serves: the fastest one ends the gap."""
    if part.group.on_demand.standbys >= part.wanted or any(s.serving for s in standing_in):
        return 0  # stopped standbys start sooner
    return min(part.surge, 2 * wanted - 1)
