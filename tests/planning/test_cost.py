"""What a pool costs: machines, and the responses that leave the clouds."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.choices import TrafficSpec
from fogft.model.replica import Offer, Placement
from fogft.model.spec import HedgingMode, ServiceSpec
from fogft.planning.cost import (
    GB,
    HOURS_A_MONTH,
    UNKNOWN_EGRESS_USD_PER_GB,
    Cost,
    cost,
    egress_bytes_per_s,
    egress_price,
)

GB_AN_HOUR = TrafficSpec(requests_per_s=10.0, response_bytes=GB / 36_000)


def service(hedging: HedgingMode = HedgingMode.ALL, traffic: TrafficSpec = GB_AN_HOUR):
    return ServiceSpec("/plan", "nav_msgs/srv/GetPlan", hedging=hedging, traffic=traffic)


def offer(cloud: str, usd_per_hour: float = 0.5, egress_usd_per_hour: float = 0.0) -> Offer:
    place = Placement(cloud, "r", "a", "m1")
    return Offer(place, usd_per_hour, egress_usd_per_hour=egress_usd_per_hour)


@pytest.mark.parametrize(
    ("hedging", "share"),
    [(HedgingMode.ALL, 1.0), (HedgingMode.AUTO, 1.0), (HedgingMode.FAILOVER, 0.25)],
)
def test_each_replica_that_is_asked_sends_its_response(hedging, share):
    """With failover one of them does; what comes in costs nothing."""
    services = [service(hedging), service(hedging, TrafficSpec(5.0, request_bytes=1e9))]
    assert egress_bytes_per_s(services, 4) * 3600 / GB == pytest.approx(share)
    assert egress_bytes_per_s(services, 0) == egress_bytes_per_s(services, 1)
    assert egress_bytes_per_s([], 4) == 0.0


def test_what_leaves_is_paid_at_the_price_of_its_cloud():
    found = cost([offer("aws"), offer("gcp"), offer("local"), offer("new")], [service()])
    assert found.machines == pytest.approx(2.0)
    assert found.egress == pytest.approx(0.09 + 0.12 + 0.0 + UNKNOWN_EGRESS_USD_PER_GB)
    assert egress_price("new") == UNKNOWN_EGRESS_USD_PER_GB


def test_what_a_price_holds_already_for_egress_is_not_paid_twice():
    """Offers are compared with their egress in the price: the bill has it once."""
    found = cost([offer("aws", 0.59, egress_usd_per_hour=0.09)], [service()])
    assert (found.machines, found.egress) == pytest.approx((0.5, 0.09))
    assert found.usd_per_hour == pytest.approx(0.59)
    assert found.usd_per_month == pytest.approx(0.59 * HOURS_A_MONTH)


@given(
    st.lists(st.sampled_from(["aws", "gcp", "azure", "local"]), max_size=5),
    st.lists(st.sampled_from(HedgingMode), max_size=3),
)
def test_one_more_replica_never_costs_less(clouds, hedging):
    offers, services = [offer(cloud) for cloud in clouds], [service(mode) for mode in hedging]
    before, after = cost(offers, services), cost([*offers, offer("aws")], services)
    assert after.machines == pytest.approx(before.machines + 0.5)
    assert after.usd_per_hour >= before.usd_per_hour
    assert before == Cost(before.machines, before.egress)
