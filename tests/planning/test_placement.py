"""Where the next replica goes."""

from __future__ import annotations

import random
from collections.abc import Collection, Sequence
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from fogft.model.reason import Cause, Reason
from fogft.model.replica import Offer, Placement
from fogft.planning.listing import Scale, catalogue
from fogft.planning.observed.backoff import EVERYWHERE, Backoff
from fogft.planning.placement import Choice, Market, crowding

placements = st.builds(
    Placement,
    st.sampled_from(["c1", "c2"]),
    st.sampled_from(["r1", "r2"]),
    st.sampled_from(["a", "b"]),
    st.sampled_from(["m1", "m2"]),
)
offers = st.lists(
    st.builds(Offer, placements, st.sampled_from([0.1, 0.2, 0.3])),
    min_size=1,
    unique_by=lambda o: o.placement,
)


def choose(
    offers: Sequence[Offer],
    *,
    taken: Collection[Placement],
    excluded: Collection[str] = (),
    budget_usd_per_hour: float | None = None,
    **pauses: Any,
) -> Choice:
    listing = catalogue(offers).listing(None, None, excluded, Scale())
    return Market(listing, **pauses).choose(taken, budget_usd_per_hour=budget_usd_per_hour)


REST = Backoff(until=1.0, failures=1, cause=Cause.CAPACITY)


@given(offers, st.lists(placements, max_size=6))
def test_the_least_crowded_cloud_wins(offers: list[Offer], taken: list[Placement]) -> None:
    """No offer in a cloud with fewer of our replicas is passed over, whatever it costs."""
    chosen = choose(offers, taken=taken).offer
    assert chosen is not None
    count = crowding(taken)
    assert count[chosen.placement.cloud] == min(count[o.placement.cloud] for o in offers)


@given(offers, st.lists(placements, max_size=6))
def test_price_decides_within_equal_domains(offers: list[Offer], taken: list[Placement]) -> None:
    """Among offers whose domains are equally crowded, none is cheaper than the chosen one."""
    chosen = choose(offers, taken=taken).offer
    assert chosen is not None
    count = crowding(taken)

    def crowd(offer: Offer) -> list[int]:
        return [count[domain] for domain in offer.placement.domains]

    assert chosen.usd_per_hour == min(o.usd_per_hour for o in offers if crowd(o) == crowd(chosen))


@given(offers, st.lists(placements, max_size=6), st.integers())
def test_choice_is_deterministic(offers: list[Offer], taken: list[Placement], seed: int) -> None:
    """The order in which offers come does not matter."""
    shuffled = list(offers)
    random.Random(seed).shuffle(shuffled)
    assert choose(offers, taken=taken) == choose(shuffled, taken=taken)


@given(offers, placements)
def test_excluded_and_resting_are_never_chosen(offers: list[Offer], place: Placement) -> None:
    """Neither what the user excluded nor what is in backoff."""
    excluded = choose(offers, taken=[], excluded=[f"{place.cloud}/{place.region}"])
    backing_off = choose(offers, taken=[], backing_off={place.location: REST})
    if excluded.offer is not None:
        region = (excluded.offer.placement.cloud, excluded.offer.placement.region)
        assert region != (place.cloud, place.region)
    if backing_off.offer is not None:
        assert backing_off.offer.placement.location != place.location
    for choice in (excluded, backing_off):
        assert (choice.offer is None) == bool(choice.why_not)


@given(offers, placements)
def test_avoided_location_is_the_last_resort(offers: list[Offer], place: Placement) -> None:
    """It is chosen only when every offer lies there."""
    chosen = choose(offers, taken=[], avoid=[place.location]).offer
    assert chosen is not None
    if chosen.placement.location == place.location:
        assert {o.placement.location for o in offers} == {place.location}


def test_each_reason_is_told_apart() -> None:
    """No offers, all excluded, all backing_off, too dear, and nothing anywhere."""
    place = Placement("c1", "r1", "a", "m1")
    offer = Offer(place, 0.5)
    assert choose([], taken=[]).why_not == Reason(Cause.NOTHING_OFFERED)
    assert choose([offer], taken=[], excluded=["c1"]).why_not == Reason(Cause.ALL_EXCLUDED)
    full = Reason(Cause.CAPACITY, location="c1/r1/a")
    assert choose([offer], taken=[], backing_off={place.location: REST}).why_not == Reason(
        Cause.ALL_BACKING_OFF, because=(full,)
    )
    assert choose([offer], taken=[], budget_usd_per_hour=0.4).why_not == Reason(
        Cause.OVER_BUDGET, usd_per_hour=0.5, limit_usd_per_hour=0.4
    )
    assert choose([offer], taken=[], backing_off={EVERYWHERE: REST}).why_not == Reason(
        Cause.BACKING_OFF, count=1, because=(Reason(Cause.CAPACITY),)
    )


def test_a_prefix_of_a_name_is_not_its_location() -> None:
    """Excluding `c1/r1` keeps `c1/r10`."""
    offer = Offer(Placement("c1", "r10", "a", "m1"), 0.1)
    assert choose([offer], taken=[], excluded=["c1/r1"]).offer == offer
