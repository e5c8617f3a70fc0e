"""The spot market that a generator makes up, in a handful of numbers.

Not here: making a market of them (`generator`) and finding them in traces (`fitting`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

from fogft.errors import FogftError
from fogft.model.choices import Assumption

MAX_CORRELATION = 0.95
HINT = "write `KEY=VALUE,...`, such as `mttf_s=54000,mttr_s=3600,correlation=0.22,boot_s=240`"


@dataclass(frozen=True)
class Timing:
    """How fast machines come and go. Seconds."""

    # From the order until the service answers, on average; each launch takes between 3/4 and
    # 5/4 of it, all equally likely.
    boot_s: float = 240.0
    notice_s: float = 120.0  # between a preemption notice and the end. 0: no notice
    # Until the cloud accepts or refuses an order; as measured through SkyPilot on an emulated AWS.
    answer_s: float = 28.0
    detect_s: float = 5.0  # until the loss of a machine without a notice is seen
    # Mean time to the failure of an on-demand machine, as `availability` assumes; 0: never.
    on_demand_mttf_s: float = Assumption.on_demand_uptime_s
    on_demand_refused: float = 0.0  # share of the orders of on-demand machines
    launch_fails: float = 0.0  # share of the machines that are accepted and never serve
    spot_quota: float = 0.0  # the most spot machines of a region; 0: any number


@dataclass(frozen=True)
class MarketModel:
    """Zones that have room for `mttf_s` and then none for `mttr_s`, on average.

    The defaults were fitted to the public traces of AWS V100 machines (nine zones, 45 days
    of 2023): scarce machines, so on the safe side for common ones.
    """

    mttf_s: float = 12_000.0
    mttr_s: float = 6_600.0
    correlation_region: float = 0.43  # of having room, between two zones of one region; below 1
    # Between zones of two regions of one cloud; at most that of a region.
    correlation_cloud: float = 0.14
    correlation_world: float = 0.0  # between zones of two clouds; at most that of a cloud
    # Share of a zone's changes that strike its whole region at one moment. Where
    # `correlation_region` is too low for it, as much as that allows.
    together: float = 0.16
    # How long times of scarcity and plenty last: the correlation time.
    regime_s: float = 12 * 3600.0

    @property
    def availability(self) -> float:
        """Fraction of time that a zone has room."""
        return self.mttf_s / (self.mttf_s + self.mttr_s)


@dataclass(frozen=True)
class Rates:
    """What the generator works with; docs/design/simulation.md derives it."""

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
_SHARES = ("together", "on_demand_refused", "launch_fails")
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
    least = 1e-9 if key in _POSITIVE else 0.0
    most = 1.0 if key in _SHARES else 1e12
    most = MAX_CORRELATION if key.startswith("correlation") else most
    if not least <= value <= most:
        range_ = f"from {'above ' * bool(least)}0 to {most:g}"
        raise FogftError(f"--model: `{key}` must be {range_}, not `{text:.40}`", HINT)
    return value


def applied(
    market: MarketModel, timing: Timing, values: Mapping[str, float]
) -> tuple[MarketModel, Timing]:
    """Return both with some values changed; ``correlation`` stands for region and cloud."""
    chosen = dict(values)
    if "correlation" in chosen:
        both = chosen.pop("correlation")
        chosen = {"correlation_region": both, "correlation_cloud": both, **chosen}
    market = replace(market, **{k: v for k, v in chosen.items() if k not in TIMING_KEYS})
    timing = replace(timing, **{k: v for k, v in chosen.items() if k in TIMING_KEYS})
    falling = [getattr(market, name) for name in _FRACTIONS]
    if sorted(falling, reverse=True) != falling:
        raise FogftError(
            "--model: zones of two clouds cannot be more alike than zones of one, nor zones of "
            f"two regions more than zones of one: region {falling[0]:g}, cloud {falling[1]:g}, "
            f"world {falling[2]:g}",
            "let `correlation_region` >= `correlation_cloud` >= `correlation_world`",
        )
    rates(market)
    return market, timing
