"""Which launches are needed: missing replicas at once, replacements one at a time. Pure.

Not here: where they go and whether the budget allows them (`buying`).
"""

import itertools
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

from fogft.model.groups import STAND_INS, Group, group_of, is_stand_in
from fogft.model.reason import Cause, Reason, because
from fogft.planning.classification import Classification
from fogft.planning.observed.health import Assessment
from fogft.planning.observed.history import History


class Need(NamedTuple):
    """A launch that is needed."""

    slot: int
    reason: Reason
    group: Group
    replaces: Assessment | None = None  # the replica it replaces; None to fill an empty slot
    stands_in: bool = False  # an on-demand machine that serves until a spot one does


def needed_launches(
    groups: Sequence[Group],
    counts: Sequence[int],
    machines: Classification,
    history: History,
    *,
    settling: bool = False,
) -> list[Need]:
    """Return the launches needed; no replacement while a new replica proves itself (`settling`)."""
    needs: list[Need] = []
    for group, wanted in zip(groups, counts, strict=True):
        here = machines.part(groups, group)
        if wanted > len(here.good) + len(here.replaced):
            needs += _missing(group, wanted, here, history)
    if needs or not machines.replaced or machines.ending or settling:
        return needs
    if any(not s.ever_ready for s in machines.good):  # one is on its way
        return []
    for replica in machines.replaced:
        group = group_of(groups, replica.slot)
        here = machines.part(groups, group)
        if len(here.good) + len(here.replaced) <= counts[list(groups).index(group)]:
            # In the same slot, unless a good replica is there, which fills in for another slot.
            used = {s.slot for s in (*here.good, *here.replaced)}
            taken = {s.slot for s in here.good}
            free = replica.slot not in taken and group.owns(replica.slot)
            slot = replica.slot if free else _lowest_free(group.first_slot, used)
            return [Need(slot, _replaces(replica), group, replica)]
    return []


def _missing(
    group: Group, wanted: int, machines: Classification, history: History
) -> Iterator[Need]:
    missing = wanted - len(machines.good) - len(machines.replaced)
    used = {s.slot for s in (*machines.good, *machines.replaced)}
    vacant = [
        s
        for s in machines.lost
        if s.slot not in used and group.owns(s.slot) and not is_stand_in(s.slot)
    ]
    for replica in vacant:
        if missing > 0 and replica.slot not in used:
            used.add(replica.slot)
            missing -= 1
            yield Need(replica.slot, _replaces(replica), group, replica)
    used |= {s.slot for s in vacant}
    for _ in range(missing):
        slot = _lowest_free(group.first_slot, used)
        used.add(slot)
        before = history.generations[slot]
        follows = Reason(Cause.FOLLOWS, replica=f"{slot}.{before}")
        yield Need(slot, follows if before else Reason(Cause.NEW_SLOT), group)


def stand_in(group: Group, used: Collection[int]) -> Need:
    """Return the launch of an on-demand machine that serves until a spot one does."""
    slot = _lowest_free(group.first_slot + STAND_INS, used)
    return Need(slot, Reason(Cause.STANDS_IN), group, stands_in=True)


def _lowest_free(first: int, used: Collection[int]) -> int:
    return next(slot for slot in itertools.count(first) if slot not in used)


def _replaces(replica: Assessment) -> Reason:
    return Reason(Cause.REPLACES, replica=replica.id.short, because=because(replica.why))
