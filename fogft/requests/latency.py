"""Recent latencies: quantiles of a decaying histogram. Pure.

Buckets grow by 10 % from 0.1 ms to over a day, so a quantile is accurate to about 5 %. A stopped
attempt counts with the time until it was stopped: leaving it out would make a slow replica look as
fast as its fast answers.
"""

import math

_FIRST_S = 1e-4
_GROWTH = 1.1
_LOG_GROWTH = math.log(_GROWTH)
_MIDDLE = _GROWTH**-0.5
_BUCKETS = 220
_RESCALE_AT = 1e100


class Latencies:
    """Recent latencies of one replica's answers to one service."""

    per_sample = 2.0 ** (1.0 / 200.0)  # weight growth per sample: after 200 more, one weighs half
    half_life_s = 60.0  # weights halve with time, too

    def __init__(self) -> None:
        self._weights: dict[int, float] = {}  # by bucket, for buckets that have had a sample
        self._weight = 1.0  # of the next sample: it grows, instead of all others shrinking
        self._total = 0.0
        self._newest: float | None = None
        self._new: list[tuple[float, float, float]] = []  # samples not yet in a bucket
        self.samples = 0

    def add(self, took_s: float, now: float, share: float = 1.0) -> None:
        """Count a latency, in seconds, as this fraction of a sample."""
        self._new.append((took_s, now, share))
        self.samples += 1

    def _sort_new(self) -> None:
        """Put new samples into buckets: in batches, as quantiles are needed less often."""
        for took_s, now, share in self._new:
            if self._newest is not None and now > self._newest:
                self._weight *= 2.0 ** min((now - self._newest) / self.half_life_s, 60.0)
            self._newest = now
            self._weight *= self.per_sample
            if self._weight > _RESCALE_AT:
                self._rescale()
            bucket = 0  # the first bucket whose upper end is not below the sample
            if took_s > _FIRST_S:
                bucket = min(_BUCKETS - 1, math.ceil(math.log(took_s / _FIRST_S) / _LOG_GROWTH))
            self._weights[bucket] = self._weights.get(bucket, 0.0) + self._weight * share
            self._total += self._weight * share
        self._new.clear()

    def _rescale(self) -> None:
        scale = 1.0 / self._weight
        self._weights = {bucket: weight * scale for bucket, weight in self._weights.items()}
        self._total *= scale
        self._weight = 1.0

    def quantile_s(self, share: float) -> float | None:
        """Return the time within which this share of answers arrived; None before the first."""
        self._sort_new()
        above = (1.0 - share) * self._total
        for bucket in sorted(self._weights, reverse=True):  # the usual quantiles are high
            weight = self._weights[bucket]
            if weight > above:  # as if samples were spread evenly over the bucket
                return _FIRST_S * math.pow(_GROWTH, bucket - above / weight)
            above -= weight
        return _FIRST_S if self.samples else None

    def mean_below_s(self, share: float) -> float | None:
        """Return the mean latency of the fastest `share` of answers; None before the first."""
        self._sort_new()
        left, sum_below = share * self._total, 0.0
        for bucket in sorted(self._weights):
            weight = min(self._weights[bucket], left)
            sum_below += weight * _FIRST_S * _GROWTH**bucket * _MIDDLE
            left -= weight
        return max(_FIRST_S, sum_below / (share * self._total)) if self.samples else None
