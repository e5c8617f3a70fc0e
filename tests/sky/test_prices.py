"""Offers: the catalogue's, with live prices where they can be had, kept for a while."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from fogft.cloud.sky import prices
from fogft.cloud.sky.prices import FRESH_S, USABLE_S, Prices
from fogft.cloud.sky.sdk import RefusedError
from fogft.errors import CloudUnreachable, SpecError
from fogft.model.replica import Offer, Placement
from tests.fakes.sky import EAST, WEST, ScriptedProvider, ScriptedSky

MORE = prices.extras_usd_per_hour(EAST, {})


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
        WEST, 0.011 + MORE, "live", 1000.0,
    )  # fmt: skip
    assert (east.placement, east.usd_per_hour, east.source) == (EAST, 0.02 + MORE, "catalogue")


def test_where_the_cloud_chooses_the_zone_the_dearest_one_counts(market: Market):
    """A budget that holds for it holds for all."""
    anywhere = replace(EAST, zone="")
    market.sky.sold = [Offer(anywhere, 0.02, "catalogue")]
    market.provider.prices = {("us-east-1a", "m6i.large"): 0.03, ("us-east-1b", "m6i.large"): 0.05}
    [offer] = market.prices.offers({})
    assert (offer.placement, offer.usd_per_hour, offer.source) == (anywhere, 0.05 + MORE, "live")


def test_on_demand_offers_keep_the_catalogues_price(market: Market):
    steady = Placement("aws", "us-west-2", "us-west-2a", "m6i.large", spot=False)
    market.sky.sold = [Offer(steady, 0.1, "catalogue")]
    market.provider.prices = {("us-west-2a", "m6i.large"): 0.011}
    assert market.offers()[0].usd_per_hour == 0.1 + MORE


@pytest.mark.parametrize("trouble", ["allowed", "reachable"])
def test_without_live_prices_the_catalogue_has_to_do(market: Market, trouble: str):
    setattr(market.provider, trouble, False)
    assert [o.usd_per_hour for o in market.offers()] == [0.02 + MORE, 0.03 + MORE]


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
    assert [o.usd_per_hour for o in market.offers()] == [0.05 + MORE]
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
    with pytest.raises(SpecError, match=r"^resources: SkyPilot rejects"):
        market.offers()


def test_disk_and_address_are_part_of_the_price_and_named(market: Market):
    """AWS's list prices: 64 GB of gp3 cost 5.12 dollars a month, an address half a cent an hour."""
    market.sky.sold = [Offer(EAST, 0.02, "catalogue"), Offer(replace(EAST, cloud="vast"), 0.02)]
    elsewhere, here = market.offers()
    assert elsewhere.usd_per_hour == 0.02
    assert here.extras_usd_per_hour == pytest.approx(5.12 / 730 + 0.005)
    assert here.usd_per_hour == pytest.approx(0.02 + here.extras_usd_per_hour)
    [_, large] = market.prices.offers({"infra": "aws", "disk_size": "1TB"})
    assert large.extras_usd_per_hour == pytest.approx(1024 * 0.08 / 730 + 0.005)


@pytest.mark.parametrize(
    ("asked", "gb"),
    [(64, 64), ("100", 100), ("2TB", 2048), ("512 MB", 0.5), ("much", 0), (None, 0)],
)
def test_a_disk_size_is_read_as_skypilot_reads_it(asked: object, gb: float):
    assert prices.disk_gb(asked) == pytest.approx(gb)


def test_skypilot_is_asked_with_all_that_a_launch_adds(market: Market):
    market.offers()
    asked = market.sky.asked_for
    assert (asked["disk_size"], asked["ports"]) == (64, [7448])
    assert asked["autostop"]["down"] is True
    market.prices.offers({"infra": "aws", "ports": [], "disk_size": 30})
    assert "ports" not in market.sky.asked_for, "a replica that dials out opens none"
    assert market.sky.asked_for["disk_size"] == 30
    [empty, _] = market.prices.offers({"infra": "aws", "disk_size": None})
    assert market.sky.asked_for["disk_size"] == 64
    assert empty.extras_usd_per_hour == pytest.approx(MORE)


def test_what_cannot_be_launched_is_left_out_with_the_reason(market: Market):
    market.sky.left_out = {"yotta": "machines cannot terminate themselves"}
    assert len(market.offers()) == 2
    assert market.prices.left_out() == ["`yotta` is left out: machines cannot terminate themselves"]
    market.sky.sold = []
    with pytest.raises(
        SpecError, match="`yotta` is left out: machines cannot terminate themselves"
    ):
        market.prices.offers({"infra": "yotta"})


def test_a_location_sells_its_cheapest_type_and_remembers_four_others(market: Market):
    """By live prices; none beyond a limit, none at more than twice the cheapest one's price."""
    kinds = [replace(EAST, instance=f"m{n}.large") for n in range(8)]
    market.sky.sold = [Offer(kind, 0.05 + n / 100, "catalogue") for n, kind in enumerate(kinds)]
    market.provider.prices = {("us-east-1a", "m7.large"): 0.04, ("us-east-1a", "m1.large"): 0.3}
    [offer] = market.offers()
    assert offer.placement.instance == "m7.large"
    others = market.prices.instead(offer.placement, None)
    assert [o.placement.instance for o in others] == [
        "m0.large",
        "m2.large",
        "m3.large",
        "m4.large",
    ]
    within = market.prices.instead(offer.placement, 0.075 + MORE)
    assert [o.placement.instance for o in within] == ["m0.large", "m2.large"]
    assert market.prices.instead(WEST, None) == []
    market.sky.sold = market.sky.sold[-1:]
    market.prices.offers({"infra": "aws", "instance_type": "m7.large"})
    assert market.prices.instead(offer.placement, None) == [], "who asked for it alone gets it"
    market.now += USABLE_S + 1
    market.sky.sold = [Offer(kind, 0.05, "catalogue") for kind in kinds]
    [offer] = market.offers()
    assert market.prices.instead(offer.placement, None), "who asks no more limits nobody"


def test_what_the_accounts_quota_forbids_is_not_offered_and_the_quota_is_named(market: Market):
    """A new account has none for spot GPUs; what cannot be read forbids nothing."""
    gpu = replace(EAST, instance="g4dn.xlarge")
    market.sky.sold.append(Offer(gpu, 0.2, "catalogue"))
    market.sky.quotas = {
        ("g4dn.xlarge", True): ("L-3819A6DF", 4.0),
        ("m6i.large", True): ("L-34B43A08", 2.0),
    }
    market.provider.quotas = {("us-east-1", "L-3819A6DF"): 0.0, ("us-east-1", "L-34B43A08"): 64.0}
    assert {o.placement.instance for o in market.offers()} == {"m6i.large"}
    [said] = market.prices.left_out()
    assert (
        "`g4dn.xlarge` spot in `aws/us-east-1` is left out: the quota L-3819A6DF allows 0" in said
    )
    market.provider.allowed = False
    unknown = Market()
    unknown.sky, unknown.prices.sky = market.sky, market.sky
    assert unknown.prices.offers({"infra": "aws"})
    market.sky.sold = [Offer(gpu, 0.2, "catalogue")]
    with pytest.raises(SpecError, match="L-3819A6DF"):
        market.prices.offers({"infra": "aws", "accelerators": "T4"})


def test_quotas_that_may_not_be_read_are_told_and_forbid_nothing(market: Market):
    market.sky.sold = [Offer(EAST, 0.02, "catalogue")]
    market.sky.quotas = {("m6i.large", EAST.spot): ("L-34B43A08", 2.0)}
    market.provider.allowed = False
    assert len(market.prices.offers({"infra": "aws"})) == 1
    (said,) = market.prices.left_out()
    assert said.endswith("so offers above them are shown: UnauthorizedOperation")
