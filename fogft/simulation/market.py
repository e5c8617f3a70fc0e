"""A simulated spot market: the offers, and each location's capacity over time.

Not here: the machines themselves (`world`).
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fogft.model.replica import Offer
from fogft.simulation.model import Timing
from fogft.simulation.timeline import Timeline

FindOffers = Callable[[Mapping[str, Any]], Sequence[Offer]]


def remembered(find: FindOffers) -> FindOffers:
    """Return a caching wrapper: nothing changes during a simulation."""
    known: list[tuple[Mapping[str, Any], Sequence[Offer]]] = []

    def ask(resources: Mapping[str, Any]) -> Sequence[Offer]:
        for asked, sold in known:
            if asked == resources:
                return sold
        known.append((resources, find(resources)))
        return known[-1][1]

    return ask


@dataclass(frozen=True)
class Market:
    """The offers, and each location's capacity for spot machines (empty: on demand only)."""

    find: FindOffers
    timelines: Mapping[str, Timeline]
    timing: Timing = field(default_factory=Timing)
    # Location -> price of a spot machine over time, if it is not that of `find`.
    prices: Mapping[str, Timeline] = field(default_factory=dict)

    def offers(self, resources: Mapping[str, Any]) -> list[Offer]:
        """Return the matching offers, without spot offers in locations of unknown capacity."""
        return [
            o
            for o in self.find(resources)
            if not o.placement.spot or o.placement.location in self.timelines
        ]


@dataclass(frozen=True)
class Change:
    """A change of a location's capacity."""

    at_s: float  # from then on, no more machines than `capacity` are accepted
    location: str
    capacity: int
    ends_s: float  # when surplus machines end; after `at_s` if there is a notice


def changes(market: Market, tick_s: float) -> Iterator[Change]:
    """Yield the changes, times rounded up to whole ticks, not sorted across locations.

    A loss is announced `notice_s` ahead, but not before the lost capacity was there.
    """
    for location, timeline in market.timelines.items():
        before = 0
        came_s = 0.0
        for at, capacity in timeline.changes:
            at_s = rounded_up(at, tick_s)
            announced_s = at_s
            if capacity <= before:
                notice_s = rounded_up(market.timing.notice_s, tick_s)
                announced_s = max(came_s, at_s - notice_s, 0.0)
            yield Change(announced_s, location, capacity, at_s)
            came_s, before = announced_s, capacity


def rounded_up(seconds: float, tick_s: float) -> float:
    """Return the next whole number of ticks."""
    return math.ceil(seconds / tick_s) * tick_s if math.isfinite(seconds) else seconds
