"""The cost of a pool per hour and month, egress included. Pure arithmetic.

Clouds charge for outgoing traffic: one response from each replica that gets a request, late
responses included.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from fogft.model.replica import Offer
from fogft.model.spec import HedgingMode, ServiceSpec

HOURS_A_MONTH = 730.0
GB = 1e9
# To the Internet, US dollars per GB: the list prices of the first paid tier, as of 2024-11.
EGRESS_USD_PER_GB = {"aws": 0.09, "azure": 0.087, "gcp": 0.12, "local": 0.0}
UNKNOWN_EGRESS_USD_PER_GB = 0.12


@dataclass(frozen=True)
class Cost:
    """US dollars per hour."""

    machines: float
    egress: float  # outgoing traffic; 0 if the pool file gives no `traffic`

    @property
    def usd_per_hour(self) -> float:
        """The total per hour."""
        return self.machines + self.egress

    @property
    def usd_per_month(self) -> float:
        """The total for 730 hours."""
        return self.usd_per_hour * HOURS_A_MONTH


def cost(offers: Sequence[Offer], services: Iterable[ServiceSpec]) -> Cost:
    """Return the cost of replicas (one offer each) that run these services."""
    machines = sum(offer.usd_per_hour - offer.egress_usd_per_hour for offer in offers)
    each = egress_bytes_per_s(services, len(offers)) * 3600 / GB
    return Cost(machines, sum(each * egress_price(offer.placement.cloud) for offer in offers))


def egress_bytes_per_s(services: Iterable[ServiceSpec], replicas: int) -> float:
    """Return the egress of each of this many replicas, in bytes per second."""
    # Under `auto` an idle replica gets a copy of every request: this is the upper bound.
    share = {HedgingMode.FAILOVER: 1.0 / max(1, replicas)}
    return sum(
        one.traffic.requests_per_s * one.traffic.response_bytes * share.get(one.hedging, 1.0)
        for one in services
    )


def egress_price(cloud: str) -> float:
    """Return a cloud's egress price for a GB, in US dollars."""
    return EGRESS_USD_PER_GB.get(cloud, UNKNOWN_EGRESS_USD_PER_GB)
