"""Which launches are called for: what is missing at once, replacements one at a time. Pure.

Owns: slots and reasons of launches.
Not here: where they go and whether they can be paid (`buying`).
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

from fogft.model.groups import CRITICAL, Group, is_stand_in
from fogft.model.reason import Cause, Reason, because
from fogft.planning.endings import Census, Standing
from fogft.planning.observed.history import History


class Need(NamedTuple):
    """One launch that is called for.

    Attributes:
        replaces: Whom it replaces; None to fill an empty slot.
        stands_in: An on-demand machine is to serve until a spot one does.
    """

    slot: int
    reason: Reason
    group: Group
    replaces: Standing | None = None
    stands_in: bool = False


def home(groups: Sequence[Group], slot: int) -> Group:
    """Return the group that a slot's replica counts for: its own, else the last ordinary one."""
    if len(groups) == 1:
        return groups[0]
    ordinary = [group for group in groups if group.name != CRITICAL]
    return next((group for group in groups if group.owns(slot)), ordinary[-1])


def part(census: Census, groups: Sequence[Group], group: Group) -> Census:
    """Return the part of a census that counts for a group; it is not to be changed."""
    if len(groups) == 1:
        return census
    return census.of(lambda slot: home(groups, slot) is group)


def needed_launches(
    groups: Sequence[Group],
    counts: Sequence[int],
    census: Census,
    history: History,
    *,
    settling: bool = False,
) -> list[Need]:
    """Return the launches called for, over all groups.

    Args:
        settling: A newcomer has yet to prove itself: no further one is replaced meanwhile.
    """
    needs: list[Need] = []
    for group, wanted in zip(groups, counts, strict=True):
        here = part(census, groups, group)
        if wanted > len(here.good) + len(here.replaced):
            needs += _missing(group, wanted, here, history)
    if needs or not census.replaced or census.ending or settling:
        return needs
    if any(not s.ever_ready for s in census.good):  # one is coming
        return []
    return _replacement(groups, counts, census)


def _replacement(groups: Sequence[Group], counts: Sequence[int], census: Census) -> list[Need]:
    """Return the launch of one successor; none where none is called for."""
    for standing in census.replaced:
        group = home(groups, standing.slot)
        here = part(census, groups, group)
        if len(here.good) + len(here.replaced) <= counts[list(groups).index(group)]:
            # Its slot, unless a good one lives there: that one then stands for another.
            used = {s.slot for s in (*here.good, *here.replaced)}
            taken = {s.slot for s in here.good}
            free = standing.slot not in taken and group.owns(standing.slot)
            slot = standing.slot if free else _lowest_free(group, used)
            return [Need(slot, _replaces(standing), group, standing)]
    return []


def _missing(group: Group, wanted: int, census: Census, history: History) -> Iterator[Need]:
    missing = wanted - len(census.good) - len(census.replaced)
    used = {s.slot for s in (*census.good, *census.replaced)}
    vacant = [
        s
        for s in census.lost
        if s.slot not in used and group.owns(s.slot) and not is_stand_in(s.slot)
    ]
    lost_slots = {s.slot for s in vacant}
    for standing in vacant:
        if missing > 0 and standing.slot not in used:
            used.add(standing.slot)
            missing -= 1
            yield Need(standing.slot, _replaces(standing), group, standing)
    used |= lost_slots
    for _ in range(missing):
        slot = _lowest_free(group, used)
        used.add(slot)
        yield Need(slot, _vacancy(slot, history), group)


def stand_in(group: Group, used: Collection[int]) -> Need:
    """Return the launch of an on-demand machine that serves until a spot one does."""
    slot = next(slot for slot in itertools.count(group.first_stand_in) if slot not in used)
    return Need(slot, Reason(Cause.STANDS_IN), group, stands_in=True)


def _lowest_free(group: Group, used: set[int]) -> int:
    return next(slot for slot in itertools.count(group.first_slot) if slot not in used)


def _replaces(standing: Standing) -> Reason:
    return Reason(Cause.REPLACES, replica=standing.short, because=because(standing.why))


def _vacancy(slot: int, history: History) -> Reason:
    generation = history.generation(slot)
    if not generation:
        return Reason(Cause.NEW_SLOT)
    return Reason(Cause.FOLLOWS, replica=f"{slot}.{generation}")
