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

from fogft.simulation.model import MarketModel, rates
from fogft.simulation.timeline import UNLIMITED, Timeline, of_changes

_BURN_IN = 12  # mean times between strikes, until nothing is left of how it began

Moments = list[tuple[float, bool]]


def generate(
    model: MarketModel, locations: Sequence[str], length_s: float, chance: random.Random
) -> Mapping[str, Timeline]:
    """Return a timeline for each ``cloud/region/zone``; there is room for all or for none.

    The market is stationary: it has run for a while before it is looked at.
    """
    return _Generator(model, length_s, chance).timelines(sorted(set(locations)))


class _Generator:
    def __init__(self, model: MarketModel, length_s: float, chance: random.Random) -> None:
        self._model = model
        self._rates = rates(model)
        self._chance = chance
        self._begin_s = -_BURN_IN / self._rates.strikes
        self._end_s = length_s
        self._regimes: dict[str, Moments] = {}

    def timelines(self, locations: Sequence[str]) -> dict[str, Timeline]:
        own = self._rates.strikes * (1 - self._rates.together)
        shared = self._rates.strikes * self._rates.together
        common: dict[str, Moments] = {}
        out = {}
        for location in locations:
            region = location.rsplit("/", 1)[0]
            if region not in common:
                common[region] = self._strikes(shared, region)
            moments = sorted([*self._strikes(own, region), *common[region]])
            before = [up for at, up in moments if at <= 0]
            up_at_0 = before[-1] if before else self._lucky()
            later = [(at, UNLIMITED if up else 0) for at, up in moments if at > 0]
            out[location] = of_changes([(0.0, UNLIMITED if up_at_0 else 0), *later], self._end_s)
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

    def _drawn(self, at: float, region: str) -> bool:
        point = self._chance.random()
        sources = (
            ("", self._rates.world),
            (region.split("/", maxsplit=1)[0], self._rates.cloud),
            (region, self._rates.region),
        )
        for domain, share in sources:
            if point < share:
                return self._plenty(domain, at)
            point -= share
        return self._lucky()

    def _plenty(self, domain: str, at: float) -> bool:
        if domain not in self._regimes:
            times = [self._begin_s, *self._times(1 / self._model.regime_s)]
            self._regimes[domain] = [(time, self._lucky()) for time in times]
        regimes = self._regimes[domain]
        return regimes[bisect_right(regimes, at, key=lambda moment: moment[0]) - 1][1]

    def _lucky(self) -> bool:
        return self._chance.random() < self._model.availability
