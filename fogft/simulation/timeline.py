"""How many spot machines fit into one location, over time.

Not here: where timelines come from (`traces`, `model`) and which machines are preempted (`world`).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter

UNLIMITED = 1 << 30
PER_USD = 1_000_000  # a timeline of prices is in millionths of a US dollar per hour


@dataclass(frozen=True)
class Timeline:
    """A step function from time to capacity, from 0 on."""

    # ``(at_s, capacity)``, times ascending from 0, capacities alternating.
    changes: tuple[tuple[float, int], ...]
    length_s: float  # until when it is known

    def capacity(self, at_s: float) -> int:
        """Return how many machines fit at a time."""
        index = bisect_right(self.changes, (at_s, math.inf)) - 1
        return self.changes[max(index, 0)][1]

    def window(self, begin_s: float, length_s: float) -> Timeline:
        """Return the part from `begin_s` on, its times counted from there."""
        later = [(at - begin_s, n) for at, n in self.changes if begin_s < at < begin_s + length_s]
        return Timeline(((0.0, self.capacity(begin_s)), *later), length_s)

    def spells(self, level: int = 1) -> Iterator[tuple[bool, float, float]]:
        """Yield each spell with or without room for `level` machines: ``(room, begin, end)``."""
        states = ((at, int(n >= level)) for at, n in self.changes)
        changes = of_changes(states, self.length_s).changes
        ends = [*(at for at, _ in changes[1:]), self.length_s]
        for (begin, room), end in zip(changes, ends, strict=True):
            yield bool(room), begin, end


def of_samples(counts: Sequence[int], gap_s: float) -> Timeline:
    """Return the timeline of samples taken every `gap_s`: each holds until the next."""
    changes = ((index * gap_s, count) for index, count in enumerate(counts))
    return of_changes(changes, len(counts) * gap_s)


def of_changes(changes: Iterable[tuple[float, int]], length_s: float) -> Timeline:
    """Return the timeline of changes in order of time; those without effect are left out."""
    distinct = (next(same) for _, same in groupby(changes, itemgetter(1)))
    return Timeline(tuple(distinct), length_s)
