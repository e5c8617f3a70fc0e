"""The generator of spot markets: its parameters, and the resulting times with capacity.

docs/design/simulation.md explains it. Every random number comes from the given generator.
Not here: estimating the parameters from traces (`fitting`).
"""

import math
import random
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import MappingProxyType

from fogft.errors import FogftError
from fogft.model.choices import Assumption
from fogft.simulation.timeline import UNLIMITED, Timeline, of_changes

MAX_CORRELATION = 0.95
SLOW = 4.0
HINT = "write `KEY=VALUE,...`, such as `mttf_s=54000,mttr_s=3600,correlation=0.22,boot_s=240`"


@dataclass(frozen=True)
class Timing:
    """Delays, in seconds, and failure rates of simulated machines."""

    # From the order until the service answers, on average; each launch takes between 3/4 and
    # 5/4 of it, uniformly distributed.
    boot_s: float = 240.0
    notice_s: float = 120.0  # between a preemption notice and the end. 0: no notice
    # Until the cloud accepts or refuses an order; as measured through SkyPilot on an emulated AWS.
    answer_s: float = 28.0
    detect_s: float = 5.0  # until the loss of a machine without a notice is seen
    # Mean time to the failure of an on-demand machine, as `availability` assumes; 0: never.
    on_demand_mttf_s: float = Assumption.on_demand_uptime_s
    on_demand_refused: float = 0.0  # share of on-demand orders that are refused
    launch_fails: float = 0.0  # share of the accepted machines that never serve
    slow_setup: float = 0.0  # share of the machines whose boot takes `SLOW` times as long
    spot_quota: float = 0.0  # the most spot machines per region; 0: any number


@dataclass(frozen=True)
class MarketModel:
    """Zones with capacity for `mttf_s`, then without for `mttr_s`, on average.

    The defaults were fitted to the public traces of AWS V100 machines (nine zones, 45 days
    of 2023): scarce machines, so they are pessimistic for common ones.
    """

    mttf_s: float = 12_000.0
    mttr_s: float = 6_600.0
    correlation_region: float = 0.43  # of having room, between two zones of one region; below 1
    # Between zones of two regions of one cloud; at most that of a region.
    correlation_cloud: float = 0.14
    correlation_world: float = 0.0  # between zones of two clouds; at most that of a cloud
    # Share of a zone's changes that strike its whole region at one moment; if
    # `correlation_region` is too low for this, the highest share that it allows.
    together: float = 0.16
    # How long times of scarcity and plenty last: the correlation time.
    regime_s: float = 12 * 3600.0

    @property
    def availability(self) -> float:
        """Fraction of time that a zone has capacity."""
        return self.mttf_s / (self.mttf_s + self.mttr_s)


@dataclass(frozen=True)
class Rates:
    """The generator's rates; docs/design/simulation.md derives them."""

    strikes: float  # how often a zone's state is drawn anew, per second
    together: float  # share of the strikes that are one for the whole region
    world: float  # how likely a strike follows the world's regime; else chance decides
    cloud: float
    region: float


def rates(model: MarketModel) -> Rates:
    """Return the rates of a model. Raises FogftError: its correlations are too high together."""
    at_most = (model.correlation_region - model.correlation_cloud) / (1 - model.correlation_cloud)
    same = min(model.together / (2 - model.together), at_most)
    by_regime = (model.correlation_region - same) / (1 - same)
    strikes = (1 / model.mttf_s + 1 / model.mttr_s) / (1 - by_regime)
    remembered = strikes / (strikes + 1 / model.regime_s)
    steps = (
        model.correlation_world,
        model.correlation_cloud - model.correlation_world,
        by_regime - model.correlation_cloud,
    )
    world, cloud, region = (math.sqrt(max(step, 0.0) / remembered) for step in steps)
    if world + cloud + region > 1:
        raise FogftError(
            "--model: no market has correlations as high as these (region "
            f"{model.correlation_region:g}, cloud {model.correlation_cloud:g}, world "
            f"{model.correlation_world:g}) with regimes of {model.regime_s:g} s",
            "lower them, or make `regime_s` longer",
        )
    return Rates(strikes, 2 * same / (1 + same), world, cloud, region)


_POSITIVE = ("mttf_s", "mttr_s", "regime_s")
_SHARES = ("together", "on_demand_refused", "launch_fails", "slow_setup")
_FRACTIONS = ("correlation_region", "correlation_cloud", "correlation_world")
MARKET_KEYS = ("correlation", *(f.name for f in fields(MarketModel)))
TIMING_KEYS = tuple(f.name for f in fields(Timing))


def read_values(text: str) -> dict[str, float]:
    """Read ``KEY=VALUE,...``. Raises FogftError: a key is unknown, or a value out of range."""
    out: dict[str, float] = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        key, equals, value = (p.strip() for p in part.partition("="))
        if key not in (*MARKET_KEYS, *TIMING_KEYS):
            known = ", ".join(f"`{k}`" for k in (*MARKET_KEYS, *TIMING_KEYS))
            raise FogftError(f"--model: unknown key `{key}`", f"known: {known}")
        if not equals:
            raise FogftError(f"--model: `{key}` has no value", HINT)
        if key in out:
            raise FogftError(f"--model: `{key}` is given twice", HINT)
        out[key] = _number(key, value)
    return out


def _number(key: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise FogftError(f"--model: `{key}` must be a number, not `{text:.40}`", HINT) from None
    least = 1.0 if key in _POSITIVE else 0.0  # the simulation's step, seconds
    most = 1.0 if key in _SHARES else 1e12
    most = MAX_CORRELATION if key.startswith("correlation") else most
    if not least <= value <= most:
        range_ = f"from {least:g} to {most:g}"
        raise FogftError(f"--model: `{key}` must be {range_}, not `{text:.40}`", HINT)
    return value


def applied(
    market: MarketModel, timing: Timing, values: Mapping[str, float]
) -> tuple[MarketModel, Timing]:
    """Return both with some values changed; ``correlation`` sets region and cloud."""
    chosen = dict(values)
    if "correlation" in chosen:
        both = chosen.pop("correlation")
        chosen = {"correlation_region": both, "correlation_cloud": both, **chosen}
    market = replace(market, **{k: v for k, v in chosen.items() if k not in TIMING_KEYS})
    timing = replace(timing, **{k: v for k, v in chosen.items() if k in TIMING_KEYS})
    falling = [getattr(market, name) for name in _FRACTIONS]
    if sorted(falling, reverse=True) != falling:
        raise FogftError(
            "--model: zones of two clouds cannot be more correlated than zones of one, nor "
            f"those of two regions more than zones of one: region {falling[0]:g}, "
            f"cloud {falling[1]:g}, world {falling[2]:g}",
            "set `correlation_region` >= `correlation_cloud` >= `correlation_world`",
        )
    rates(market)
    return market, timing


_BURN_IN = 12  # mean times between strikes, until the initial state does not matter

# A time, and a number from 0 to 1: a zone has room while the number is below the zone's
# availability. So sharing numbers between zones does not change how available each one is.
Moments = list[tuple[float, float]]


def generate(
    model: MarketModel,
    locations: Sequence[str],
    length_s: float,
    chance: random.Random,
    zones: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> Mapping[str, Timeline]:
    """Return a timeline for each ``cloud/region/zone``, with capacity for all or for none.

    The market is stationary: it has run for a while before the timelines begin. `zones` have their
    own MTTF and MTTR.
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
        # A region's strike hits each of its zones: no more often than the calmest zone is hit.
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
        return regimes[bisect_right(regimes, (at, math.inf)) - 1][1]
