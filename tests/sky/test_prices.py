"""Offers: the catalogue's, with live prices where they can be had, kept for a while."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from fogft.cloud.sky.prices import FRESH_S, USABLE_S, Prices
from fogft.cloud.sky.sdk import RefusedError
from fogft.errors import CloudUnreachable, SpecError
from fogft.model.replica import Offer, Placement
from tests.sky.scripted_sky import EAST, WEST, ScriptedProvider, ScriptedSky


class Market:
    def __init__(self) -> None:
        self.now = 1000.0
        self.provider = ScriptedProvider()
        self.sky = ScriptedSky(self.provider)
        self.pending: list[Callable[[], None]] = []
        self.prices = Prices(
            self.sky, {"aws": self.provider}, lambda: self.now, lambda run: self.pending.append(run)
        )

    def offers(self) -> list[Offer]:
        return list(self.prices.offers({"infra": "aws"}))


@pytest.fixture
def market() -> Market:
    return Market()


def test_live_prices_replace_the_catalogues_and_say_so(market: Market):
    market.provider.prices = {("us-west-2a", "m6i.large"): 0.011}
    west, east = market.offers()
    assert (west.placement, west.usd_per_hour, west.source, west.as_of) == (
        WEST, 0.011, "live", 1000.0,
    )  # fmt: skip
    assert (east.placement, east.usd_per_hour, east.source) == (EAST, 0.02, "catalogue")


def test_where_the_cloud_chooses_the_zone_the_dearest_one_counts(market: Market):
    """A budget that holds for it holds for all."""
    anywhere = replace(EAST, zone="")
    market.sky.sold = [Offer(anywhere, 0.02, "catalogue")]
    market.provider.prices = {("us-east-1a", "m6i.large"): 0.03, ("us-east-1b", "m6i.large"): 0.05}
    [offer] = market.prices.offers({})
    assert (offer.placement, offer.usd_per_hour, offer.source) == (anywhere, 0.05, "live")


def test_on_demand_offers_keep_the_catalogues_price(market: Market):
    steady = Placement("aws", "us-west-2", "us-west-2a", "m6i.large", spot=False)
    market.sky.sold = [Offer(steady, 0.1, "catalogue")]
    market.provider.prices = {("us-west-2a", "m6i.large"): 0.011}
    assert market.offers()[0].usd_per_hour == 0.1


@pytest.mark.parametrize("trouble", ["allowed", "reachable"])
def test_without_live_prices_the_catalogue_has_to_do(market: Market, trouble: str):
    setattr(market.provider, trouble, False)
    assert [o.usd_per_hour for o in market.offers()] == [0.02, 0.03]


def test_prices_are_kept_then_renewed_aside_then_awaited(market: Market):
    """The planner never waits for a price that is less than an hour old."""
    market.offers()
    market.offers()
    assert len(market.sky.asked("offers")) == 1
    market.now += FRESH_S + 1
    market.sky.sold = [Offer(EAST, 0.05)]
    assert len(market.offers()) == 2
    market.offers()
    assert len(market.pending) == 1
    market.pending.pop()()
    assert [o.usd_per_hour for o in market.offers()] == [0.05]
    market.now += USABLE_S + 1
    market.sky.fail_next("offers", CloudUnreachable("no"))
    with pytest.raises(CloudUnreachable):
        market.offers()


def test_a_renewal_that_fails_keeps_the_old_prices(market: Market):
    before = market.offers()
    market.now += FRESH_S + 1
    market.sky.fail_next("offers", CloudUnreachable("no"))
    market.offers()
    market.pending.pop()()
    assert market.offers() == before


def test_resources_that_nobody_sells_or_that_are_not_valid_name_the_key(market: Market):
    market.sky.sold = []
    with pytest.raises(SpecError, match=r"^resources: "):
        market.offers()
    market.sky.fail_next("offers", RefusedError("ValueError", ["Invalid resources YAML: x"]))
    with pytest.raises(SpecError, match=r"^resources: SkyPilot refuses"):
        market.offers()
