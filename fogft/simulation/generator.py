"""Make up a spot market: for each location when it has room, correlated as the model says.

A zone is struck now and then, and each strike decides anew whether it has room: by chance,
or by the regime (scarcity or plenty) of its region, its cloud or the world. Zones are alike
because they follow the same regimes, and because some strikes meet a whole region at once.

Every random number comes from the generator handed in.
Not here: the formulas of the rates (`model`).
"""

from __future__ import annotations

import random
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

from fogft.simulation.model import MarketModel, rates
from fogft.simulation.timeline import UNLIMITED, Timeline, of_changes

_BURN_IN = 12  # mean times between strikes, until nothing is left of how it began

# When, and a number from 0 to 1: a zone has room while it is below the zone's availability. So one
# result for several zones leaves each as available as it is alone.
Moments = list[tuple[float, float]]


def generate(
    model: MarketModel,
    locations: Sequence[str],
    length_s: float,
    chance: random.Random,
    zones: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> Mapping[str, Timeline]:
    """Return a timeline for each ``cloud/region/zone``; there is room for all or for none.

    The market is stationary: it has run for a while before it is looked at.

    Args:
        zones: Location -> its own MTTF and MTTR, where they are not the model's.
    """
    own = {
        place: replace(model, mttf_s=mttf_s, mttr_s=mttr_s)
        for place, (mttf_s, mttr_s) in zones.items()
    }
    return _Generator(model, length_s, chance).timelines(sorted(set(locations)), own)


class _Generator:
    def __init__(self, model: MarketModel, length_s: float, chance: random.Random) -> None:
        self._model = model
        self._rates = rates(model)
        self._chance = chance
        self._begin_s = -_BURN_IN / self._rates.strikes
        self._end_s = length_s
        self._regimes: dict[str, Moments] = {}

    def timelines(
        self, locations: Sequence[str], zones: Mapping[str, MarketModel]
    ) -> dict[str, Timeline]:
        of_all = {place: rates(zones.get(place, self._model)).strikes for place in locations}
        # What strikes a region strikes each of its zones: no oftener than the calmest is struck.
        calmest = min(of_all.values(), default=0.0)
        shared = calmest * self._rates.together
        common: dict[str, Moments] = {}
        out = {}
        for location in locations:
            region = location.rsplit("/", 1)[0]
            if region not in common:
                common[region] = self._strikes(shared, region)
            moments = sorted([*self._strikes(of_all[location] - shared, region), *common[region]])
            before = [luck for at, luck in moments if at <= 0]
            first = before[-1] if before else self._chance.random()
            share = zones.get(location, self._model).availability
            later = [(at, luck) for at, luck in moments if at > 0]
            states = [(at, UNLIMITED * (luck < share)) for at, luck in [(0.0, first), *later]]
            out[location] = of_changes(states, self._end_s)
        return out

    def _strikes(self, rate: float, region: str) -> Moments:
        return [(at, self._drawn(at, region)) for at in self._times(rate)]

    def _times(self, rate: float) -> list[float]:
        times: list[float] = []
        if rate <= 1e-15:
            return times
        at = self._begin_s + self._chance.expovariate(rate)
        while at < self._end_s:
            times.append(at)
            at += self._chance.expovariate(rate)
        return times

    def _drawn(self, at: float, region: str) -> float:
        point = self._chance.random()
        sources = (
            ("", self._rates.world),
            (region.split("/", maxsplit=1)[0], self._rates.cloud),
            (region, self._rates.region),
        )
        for domain, share in sources:
            if point < share:
                return self._regime(domain, at)
            point -= share
        return self._chance.random()

    def _regime(self, domain: str, at: float) -> float:
        if domain not in self._regimes:
            times = [self._begin_s, *self._times(1 / self._model.regime_s)]
            self._regimes[domain] = [(time, self._chance.random()) for time in times]
        regimes = self._regimes[domain]
        return regimes[bisect_right(regimes, at, key=lambda moment: moment[0]) - 1][1]
