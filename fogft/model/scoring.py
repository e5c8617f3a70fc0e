"""Weigh a location's price against its distance. Pure.

    score = ln(usd_per_hour) + weight * ln(round trip)

The lower the better. In logarithms only ratios count: with equal weights, half the price
makes up for twice the round trip. So the order of two offers depends on those two alone,
never on what else is offered, and a margin of hysteresis is a percentage.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from fogft.model.replica import Offer, Placement

# Below these, less no longer matters.
PRICE_FLOOR_USD = 0.001
LATENCY_FLOOR_S = 0.010
# A region nobody has measured is taken for one on another continent.
UNKNOWN_RTT_S = 0.150


@dataclass(frozen=True)
class Scale:
    """The weight of round trips and what is known of them: seconds, by ``cloud/region``."""

    weight: float = 1.0
    rtt_s: Mapping[str, float] = field(default_factory=dict)

    def latency(self, placement: Placement) -> float | None:
        """Return the round trip to a placement's region in seconds; None if it is not known."""
        return self.rtt_s.get(f"{placement.cloud}/{placement.region}")

    def score(self, offer: Offer) -> float:
        """Return an offer's score; lower is better."""
        return self.score_of(offer.usd_per_hour, self.latency(offer.placement))

    def score_of(self, usd_per_hour: float, rtt_s: float | None) -> float:
        """Return the score of a price and a round trip (None: not known)."""
        return self.of_price(usd_per_hour) + self.of_distance(rtt_s)

    def of_price(self, usd_per_hour: float) -> float:
        """Return a price's part of the score."""
        return math.log(max(usd_per_hour, PRICE_FLOOR_USD))

    def of_distance(self, rtt_s: float | None) -> float:
        """Return a round trip's part of the score."""
        known = UNKNOWN_RTT_S if rtt_s is None else rtt_s
        return self.weight * math.log(max(known, LATENCY_FLOOR_S))


def gain(before: float, after: float) -> float:
    """Return how much better a score is, as a fraction in (-inf, 1): 0.3 is 30 % less."""
    return 1.0 - math.exp(after - before)
