"""`fogft plan`: what a pool would be, whatever happened to the one that runs."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fogft.model.choices import AvailabilitySpec, OnDemandSpec
from fogft.model.intent import Intent
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Offer
from fogft.planning.explain import LATELY_S, Explanation, explain
from fogft.planning.observed.history import Event, EventKind
from fogft.planning.sizing import Inputs
from tests.planning.pool_worlds import NOW, OFFERS, ON_DEMAND, PLACES, World, spec

MIXED = spec(2, on_demand=OnDemandSpec(0, fallback=True))


def explained(*events: Event):
    world = World(MIXED, events=events, offers=OFFERS + ON_DEMAND)
    return explain(Inputs(world.spec, world.intent, world.observed, world.history))


def test_a_pool_that_just_lost_a_replica_is_planned_from_nothing():
    """What is needed in haste is no part of it; that a place loses machines is."""
    lost = str(PLACES[0].location)
    happened = (
        Event(NOW - 60, EventKind.LAUNCH, 0, 1, lost),
        Event(NOW - 50, EventKind.READY, 0, 1),
        Event(NOW - 20, EventKind.GONE, 0, 1),
    )
    calm, after = explained(), explained(*happened)
    assert [replica.slot for replica in calm.replicas] == [0, 1]
    assert [replica.slot for replica in after.replicas] == [0, 1]
    assert all(replica.offer.placement.spot for replica in after.replicas)
    [there] = [one for one in after.considered if one.offer == OFFERS[0]]
    assert there.losses == 1


def of(world: World, on_demand: tuple[Offer, ...] = (), **others: float) -> Explanation:
    inputs = Inputs(world.spec, world.intent, world.observed, world.history)
    return explain(inputs, on_demand, **others)


def why_not(world: World, offer: Offer) -> Reason:
    [one] = [one for one in of(world).considered if one.offer is offer]
    assert (one.slots == ()) is (one.why_not is not None)
    assert one.why_not is not None
    return one.why_not


def test_every_offer_was_chosen_or_says_why_it_was_not():
    explained = of(World(spec(2)))
    chosen = {slot: one.offer for one in explained.considered for slot in one.slots}
    assert chosen == {launch.slot: launch.offer for launch in explained.replicas}
    assert [one.offer for one in explained.considered] == list(OFFERS)
    assert all((one.why_not is None) is bool(one.slots) for one in explained.considered)


def test_an_offer_lost_by_what_brought_it_nearest():
    """Price comes after the spread, the spread after the budget, the budget after the market."""
    dear = Offer(replace(PLACES[3], instance="m9"), 0.9)
    worse = why_not(World(spec(2), offers=(*OFFERS, dear)), dear)
    assert (worse.cause, worse.usd_per_hour) == (Cause.WORSE_SCORE, 0.9)
    assert [one.cause for one in worse.because] == [Cause.CHOSEN]
    one_cloud = World(spec(2), offers=OFFERS[:3])
    assert why_not(one_cloud, OFFERS[1]).cause in (Cause.CROWDED, Cause.WORSE_SCORE)
    capped = why_not(World(spec(1, max_usd_per_hour=0.2), offers=(OFFERS[0], dear)), dear)
    assert (capped.cause, capped.limit_usd_per_hour) == (Cause.OVER_BUDGET, 0.2)
    fits = World(spec(1, max_usd_per_hour=0.9), offers=(OFFERS[0], dear))
    assert why_not(fits, dear).cause is Cause.WORSE_SCORE
    other = why_not(World(MIXED, offers=OFFERS + ON_DEMAND), ON_DEMAND[0])
    assert (other.cause, other.name) == (Cause.OTHER_MARKET, "on demand")


def test_what_could_not_be_chosen_at_all_says_so():
    impossible = Offer(PLACES[0], -1.0)
    assert why_not(World(spec(1), offers=(*OFFERS[1:], impossible)), impossible) == Reason(
        Cause.IMPOSSIBLE_PRICE, usd_per_hour=-1.0
    )
    left_out = World(spec(1), intent=Intent(excluded=frozenset({"east/one"})))
    assert why_not(left_out, OFFERS[0]) == Reason(Cause.EXCLUDED)
    stranger = replace(OFFERS[0], group="big")
    assert why_not(World(spec(1), offers=(*OFFERS, stranger)), stranger).cause is Cause.OTHER_KIND
    refused = tuple(
        Event(NOW - 5, kind, 0, 1, PLACES[0].location, Reason(Cause.CAPACITY))
        for kind in (EventKind.LAUNCH, EventKind.REFUSED)
    )
    pause = why_not(World(spec(1), events=refused), OFFERS[0])
    assert (pause.cause, pause.count) == (Cause.BACKING_OFF, 1)
    assert pause.because == (Reason(Cause.CAPACITY),)
    assert pause.seconds > 0


@pytest.mark.parametrize(("age_s", "losses"), [(0.0, 1), (LATELY_S - 1, 1), (LATELY_S, 0)])
def test_a_loss_is_told_for_some_hours(age_s, losses):
    lost = NOW - age_s
    events = (
        Event(lost - 100, EventKind.LAUNCH, 0, 1, PLACES[0].location),
        Event(lost - 90, EventKind.READY, 0, 1),
        Event(lost, EventKind.GONE, 0, 1),
    )
    told = {one.offer: one for one in of(World(spec(1), events=events)).considered}
    assert told[OFFERS[0]].losses == losses
    assert told[OFFERS[0]].losses_per_hour
    assert told[OFFERS[1]].losses_per_hour is None
    assert told[OFFERS[1]].losses == 0


def test_round_trips_are_told_where_they_are_known():
    world = World(spec(2), rtt_s={"east/one": 0.04, "west/one": 0.02})
    explained = of(world)
    assert explained.round_trips_s == sorted(explained.round_trips_s)
    known = {one.offer.placement.cloud: one.rtt_s for one in explained.considered}
    assert (known["west"], of(World(spec(2))).round_trips_s) == (0.02, [])


@pytest.mark.parametrize(
    ("target", "usd_per_hour", "cheapest"),
    [
        (None, 5.0, True),
        (0.9, 5.0, True),
        (0.9, 0.01, False),  # one on-demand machine is enough for it
        (0.99995, 0.01, None),  # neither reaches it
    ],
)
def test_a_pool_is_compared_with_one_machine_that_would_do(target, usd_per_hour, cheapest):
    asked = {} if target is None else {"availability": AvailabilitySpec(target=target)}
    single = (Offer(ON_DEMAND[0].placement, usd_per_hour), Offer(ON_DEMAND[1].placement, 9.0))
    world = World(spec(1, **asked))
    explained = of(world, single)
    assert explained.is_cheapest is cheapest
    assert explained.single is not None
    assert explained.single[0] is single[0]
    assert of(world).is_cheapest is None, "no price is known"
    wrong = of(world, (Offer(ON_DEMAND[0].placement, -1.0),))
    assert wrong.single is None


def test_a_measured_recovery_replaces_the_assumed_one_only_without_a_target():
    """A target's replicas are counted by the file alone, and so is what is expected of them."""
    assert of(World(spec(1)), recovery_s=77.0).assumed.recovery_s == 77.0
    for said in (AvailabilitySpec(target=0.9), AvailabilitySpec(target=0.9, recovery_s=7.0)):
        asked = World(spec(1, availability=said))
        assert of(asked, recovery_s=77.0).assumed.recovery_s == said.recovery_s
