"""Means, percentiles, their ratios and bootstrap intervals. Pure: chance is an argument.

Samples of two conditions are no pairs, and are resampled independently of one another (`ratio`).
Sides that were measured in rounds, one call of each a round, are resampled by whole rounds, so
that what all sides of a round suffered stays together (`estimate_of_rounds`).
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

Sample = Sequence[float]
Statistic = Callable[[Sample], float]
RESAMPLES = 1000


@dataclass(frozen=True)
class Estimate:
    """A value with the interval that holds 95 % of its bootstrap resamples."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        if self.low == self.high:  # of one trial, or of trials that all gave the same
            return _short(self.value)
        return f"{_short(self.value)} [{_short(self.low)}, {_short(self.high)}]"


def mean(values: Sample) -> float:
    """Return the arithmetic mean.

    Raises:
        ValueError: There are no values.
    """
    if not values:
        raise ValueError("no mean of no values")
    return math.fsum(values) / len(values)


def percentile(values: Sample, percent: float) -> float:
    """Return a percentile, linear between the two nearest values, as numpy does.

    Raises:
        ValueError: There are no values, or the percentage is not in [0, 100].
    """
    if not values or not 0 <= percent <= 100:
        raise ValueError(f"no {percent} % percentile of {len(values)} values")
    ordered = sorted(values)
    place = (len(ordered) - 1) * percent / 100
    below = math.floor(place)
    above = min(below + 1, len(ordered) - 1)
    return ordered[below] + (ordered[above] - ordered[below]) * (place - below)


def median(values: Sample) -> float:
    """Return the middle value, or the mean of the two middle ones."""
    return percentile(values, 50)


def p99(values: Sample) -> float:
    """Return the 99th percentile: with 100 trials, nearly the second longest."""
    return percentile(values, 99)


def overhead_ratio(direct: float, proxied: float, round_trip: float) -> float:
    """Return (proxied - direct) / (direct + round trip)."""
    return (proxied - direct) / (direct + round_trip)


def longest_gap(moments: Sample) -> float:
    """Return the longest time between two neighbouring moments; 0 for fewer than two."""
    return max((b - a for a, b in itertools.pairwise(sorted(moments))), default=0.0)


def cumulative(values: Sample) -> tuple[list[float], list[float]]:
    """Return the values in order and the fraction of all that is not above each."""
    ordered = sorted(values)
    return ordered, [(i + 1) / len(ordered) for i in range(len(ordered))]


def estimate(
    values: Sample, statistic: Statistic, *, seed: int = 0, resamples: int = RESAMPLES
) -> Estimate:
    """Return a statistic of a sample with its 95 % bootstrap interval."""
    return _independently([values], lambda drawn: statistic(drawn[0]), seed, resamples)


def ratio(
    baseline: Sample,
    ours: Sample,
    statistic: Statistic,
    *,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Estimate:
    """Return statistic(baseline) / statistic(ours) with its 95 % bootstrap interval.

    Above 1 means that ours is faster.

    Raises:
        ValueError: A sample is empty.
    """
    return _independently(
        [baseline, ours], lambda drawn: statistic(drawn[0]) / statistic(drawn[1]), seed, resamples
    )


def estimate_of_rounds(
    sides: Mapping[str, Sample],
    statistic: Callable[[Mapping[str, Sample]], float],
    source: random.Random,
    *,
    resamples: int = RESAMPLES,
) -> Estimate:
    """Return a statistic of sides that were measured in rounds, with its 95 % interval.

    Args:
        sides: Samples of equal length; the same index is the same round.
        statistic: What to estimate from them.
        source: Where the resamples come from.
        resamples: How many.

    Raises:
        ValueError: The samples are empty or differ in length.
    """
    lengths = {len(sample) for sample in sides.values()}
    if len(lengths) != 1 or not (rounds := lengths.pop()):
        raise ValueError(f"sides need samples of one length, got {sorted(lengths)}")
    found = []
    for _ in range(resamples):
        drawn = source.choices(range(rounds), k=rounds)
        found.append(statistic({side: [s[i] for i in drawn] for side, s in sides.items()}))
    return _interval(statistic(sides), found)


def _independently(
    samples: Sequence[Sample],
    statistic: Callable[[Sequence[Sample]], float],
    seed: int,
    resamples: int,
) -> Estimate:
    if not all(samples):
        raise ValueError("no estimate of an empty sample")
    source = random.Random(seed)
    found = [
        statistic([source.choices(sample, k=len(sample)) for sample in samples])
        for _ in range(resamples)
    ]
    return _interval(statistic(samples), found)


def _interval(value: float, resampled: Sample) -> Estimate:
    return Estimate(value, percentile(resampled, 2.5), percentile(resampled, 97.5))


def _short(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
