"""Medians, percentiles and their bootstrap intervals. Pure: the random source is an argument.

The sides of a comparison are measured in rounds, one call of each side a round. A bootstrap
resample draws whole rounds, so that what all sides of a round suffered stays together.
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

Sample = Sequence[float]


@dataclass(frozen=True)
class Estimate:
    """A value with the interval that holds 95 % of its bootstrap resamples."""

    value: float
    low: float
    high: float


def percentile(values: Sample, percent: float) -> float:
    """Return the smallest value that at least `percent` of all do not exceed.

    Raises:
        ValueError: There are no values, or the percentage is not in (0, 100].
    """
    if not values or not 0 < percent <= 100:
        raise ValueError(f"no {percent} % percentile of {len(values)} values")
    return sorted(values)[max(0, math.ceil(len(values) * percent / 100) - 1)]


def median(values: Sample) -> float:
    """Return the middle value, or the mean of the two middle ones."""
    if not values:
        raise ValueError("no median of no values")
    ordered = sorted(values)
    middle = len(ordered) // 2
    return ordered[middle] if len(ordered) % 2 else (ordered[middle - 1] + ordered[middle]) / 2


def overhead_ratio(direct: float, proxied: float, round_trip: float) -> float:
    """Return (proxied - direct) / (direct + round trip)."""
    return (proxied - direct) / (direct + round_trip)


def estimate(
    sides: Mapping[str, Sample],
    statistic: Callable[[Mapping[str, Sample]], float],
    random_source: random.Random,
    *,
    resamples: int = 1000,
) -> Estimate:
    """Return a statistic of interleaved samples with its 95 % bootstrap interval.

    Args:
        sides: Samples of equal length; the same index is the same round.
        statistic: What to estimate from them.
        random_source: Where the resamples come from.
        resamples: How many.

    Raises:
        ValueError: The samples are empty or differ in length.
    """
    lengths = {len(sample) for sample in sides.values()}
    if len(lengths) != 1 or not (rounds := lengths.pop()):
        raise ValueError(f"sides need samples of one length, got {sorted(lengths)}")
    found = []
    for _ in range(resamples):
        drawn = random_source.choices(range(rounds), k=rounds)
        found.append(statistic({side: [s[i] for i in drawn] for side, s in sides.items()}))
    return Estimate(statistic(sides), percentile(found, 2.5), percentile(found, 97.5))


def longest_gap(moments: Sample) -> float:
    """Return the longest time between two neighbouring moments; 0 for fewer than two."""
    ordered = sorted(moments)
    return max((b - a for a, b in itertools.pairwise(ordered)), default=0.0)
