"""Means, 99th percentiles, their ratios and bootstrap intervals. Pure: chance is an argument.

A ratio is baseline over ours, so that above 1 means that ours is faster. The conditions are
resampled independently of one another: trials of two conditions are no pairs.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
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


def p50(values: Sample) -> float:
    """Return the median."""
    return percentile(values, 50)


def p99(values: Sample) -> float:
    """Return the 99th percentile: with 100 trials, nearly the second longest."""
    return percentile(values, 99)


def estimate(
    values: Sample, statistic: Statistic, *, seed: int = 0, resamples: int = RESAMPLES
) -> Estimate:
    """Return a statistic of a sample with its 95 % bootstrap interval."""
    return _bootstrap([values], lambda drawn: statistic(drawn[0]), seed, resamples)


def ratio(
    baseline: Sample,
    ours: Sample,
    statistic: Statistic,
    *,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Estimate:
    """Return statistic(baseline) / statistic(ours) with its 95 % bootstrap interval.

    Raises:
        ValueError: A sample is empty.
    """
    return _bootstrap(
        [baseline, ours], lambda drawn: statistic(drawn[0]) / statistic(drawn[1]), seed, resamples
    )


def cumulative(values: Sample) -> tuple[list[float], list[float]]:
    """Return the values in order and the fraction of all that is not above each."""
    ordered = sorted(values)
    return ordered, [(i + 1) / len(ordered) for i in range(len(ordered))]


def _bootstrap(
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
    return Estimate(statistic(samples), percentile(found, 2.5), percentile(found, 97.5))


def _short(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
