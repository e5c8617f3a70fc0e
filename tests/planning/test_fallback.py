"""On-demand machines beside the search for spot ones: ordered when readiness is short."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fogft.model.choices import OnDemandSpec, Spread
from fogft.model.groups import STAND_INS
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Offer, Placement
from fogft.planning.fallback import OFTEN_S, SETTLED_S
from fogft.planning.observed.history import Event, EventKind
from tests.planning.pool_worlds import NOW, PLACES, World, replica, spec

SPOT = tuple(Offer(place, 0.1) for place in PLACES)
ON_DEMAND = tuple(Offer(replace(place, spot=False), 0.3) for place in PLACES)
MIXED = spec(2, on_demand=OnDemandSpec(0, fallback=True))


def world(*parts, of=MIXED, offers=(*SPOT, *ON_DEMAND)) -> World:
    return World(of, offers=offers).having(*parts)


def stand_in(**others):
    """An on-demand replica in a slot of its own."""
    return replica(STAND_INS, at=replace(PLACES[3], spot=False), price=0.3, of=MIXED, **others)


def spot(slot: int, generation: int = 1, **others):
    return replica(slot, generation, of=MIXED, **others)


def ordered(world: World) -> list[tuple[int, bool]]:
    return [(launch.slot, launch.offer.placement.spot) for launch in world.plan().launches]


def test_a_pool_that_starts_orders_spot_machines_alone():
    assert ordered(world()) == [(0, True), (1, True)]


def test_at_a_notice_a_stand_in_is_ordered_beside_another_spot_machine():
    assert ordered(world(spot(0), spot(1, state="noticed"))) == [(1, True), (STAND_INS, False)]


@pytest.mark.parametrize("surge", [1, 3])
def test_when_all_are_lost_more_stand_ins_than_are_wanted_boot_until_the_first_serves(surge):
    """As many as the surge allows; spot machines are asked for beside those that serve."""
    of = replace(MIXED, max_surge=surge)
    both = [replica(slot, of=of, state="noticed") for slot in (0, 1)]
    slots = [STAND_INS + number for number in range(2 + surge)]
    assert ordered(world(*both, of=of)) == [(slot, False) for slot in slots]
    at = {"at": replace(PLACES[3], spot=False), "price": 0.3, "of": of}
    serving = replica(slots[0], **at)
    booting = [replica(slot, state="provisioning", **at) for slot in slots[1:]]
    first = replica(slots[0], state="provisioning", **at)
    alone = world(*both, first, *booting, of=of).plan()
    assert not alone.launches
    assert not alone.terminations
    later = world(*both, serving, *booting, of=of).plan()
    assert {end.id.slot for end in later.terminations} == {*slots[2:]}


def test_in_place_of_a_lone_one_two_stand_ins_boot_beside_another_spot_machine():
    of = replace(MIXED, replicas=1, max_surge=3)
    lost = world(replica(0, of=of, state="noticed"), of=of)
    assert ordered(lost) == [(STAND_INS, False), (STAND_INS + 1, False), (0, True)]


def test_while_an_on_demand_machine_serves_spot_is_asked_first():
    """Nobody takes it away, so one more loss is not urgent; a refusal is."""
    three = replace(MIXED, replicas=3, on_demand=OnDemandSpec(1, fallback=True))
    based = replica(0, at=replace(PLACES[3], spot=False), price=0.3, of=three)
    others = replica(1, of=three), replica(2, state="noticed", of=three)
    asked = world(based, *others, of=three)
    assert ordered(asked) == [(2, True)]
    refused = (
        Event(NOW - 2, EventKind.LAUNCH, 2, 2, PLACES[2].location),
        Event(NOW - 1, EventKind.REFUSED, 2, 2, reason=Reason(Cause.CAPACITY)),
    )
    later = replace(asked, events=(*asked.events, *refused))
    assert ordered(later) == [(2, True), (STAND_INS, False)]


def test_after_a_refusal_a_stand_in_is_ordered_beside_the_next_try():
    refused = (
        Event(NOW - 2, EventKind.LAUNCH, 1, 1, PLACES[1].location),
        Event(NOW - 1, EventKind.REFUSED, 1, 1, reason=Reason(Cause.CAPACITY)),
    )
    asked = replace(world(spot(0)), events=(*world(spot(0)).events, *refused))
    assert ordered(asked) == [(1, True), (STAND_INS, False)]


def test_a_stand_in_is_kept_within_cap_and_surge():
    noticed = spot(0), spot(1, state="noticed")
    capped = replace(MIXED, max_usd_per_hour=0.35)
    assert ordered(world(*noticed, of=capped)) == [(1, True)]
    assert ordered(world(*noticed, of=replace(MIXED, max_surge=0))) == [(1, True)]


def test_a_stand_in_stays_while_its_spot_machine_boots_and_is_not_ordered_twice():
    booting = spot(1, 2, state="provisioning")
    planned = world(spot(0), booting, stand_in()).plan()
    assert not planned.launches
    assert not planned.draining
    assert not planned.terminations


@pytest.mark.parametrize(("ready_for_s", "goes"), [(SETTLED_S - 5, False), (SETTLED_S + 5, True)])
def test_a_stand_in_goes_once_enough_spot_machines_have_been_ready_for_a_while(ready_for_s, goes):
    planned = world(spot(0, age_s=9000.0), spot(1, 2, age_s=ready_for_s + 1), stand_in()).plan()
    assert [id.slot for id in planned.draining] == [STAND_INS] * goes


def test_spot_machines_are_looked_for_while_stand_ins_serve():
    assert ordered(world(spot(0), stand_in())) == [(1, True)]


def test_on_demand_stands_in_rather_than_a_second_spot_machine_in_one_location():
    """Only one location has room: half of the pool is there already."""
    room = (SPOT[0], SPOT[1], *ON_DEMAND)
    full = (
        Event(NOW - 2, EventKind.LAUNCH, 1, 1, PLACES[1].location),
        Event(NOW - 1, EventKind.REFUSED, 1, 1, reason=Reason(Cause.CAPACITY)),
    )
    first = replica(0, at=PLACES[0], of=MIXED)
    asked = world(first, offers=room)
    asked = replace(asked, events=(*asked.events, *full))
    assert ordered(asked) == [(STAND_INS, False)]
    alone = replace(asked, offers=(SPOT[0], *ON_DEMAND))  # nothing else is sold
    assert (1, True) in ordered(alone)


@pytest.mark.parametrize(("spread", "shared"), [(Spread.PREFER, True), (Spread.REQUIRE, False)])
def test_a_second_spot_machine_in_one_location_is_a_choice(spread, shared):
    """Of four replicas two are in two locations, and no third one has room."""
    four = spec(4, on_demand=OnDemandSpec(0, fallback=True), spread=spread)
    here = [replica(slot, at=PLACES[slot], of=four) for slot in (0, 1)]
    asked = world(*here, of=four, offers=(SPOT[0], SPOT[1], *ON_DEMAND))
    spots = [is_spot for _, is_spot in ordered(asked)]
    assert (True in spots) is shared
    assert len(spots) == 2
    alone = replace(asked, offers=SPOT[:2])  # no on-demand machine can be had
    assert [is_spot for _, is_spot in ordered(alone)] == [True, True]


def test_where_spot_machines_were_lost_less_often_the_next_one_goes():
    """Three losses outweigh a tenth of the price, until they are forgotten."""
    places = [Placement("c", "r", zone, "m") for zone in ("a", "b")]
    events = [
        event
        for n in range(3)
        for event in (
            Event(NOW - 9000 + 1200 * n, EventKind.LAUNCH, 7, n + 1, "c/r/a"),
            Event(NOW - 8900 + 1200 * n, EventKind.READY, 7, n + 1),
            Event(NOW - 7900 + 1200 * n, EventKind.GONE, 7, n + 1),
        )
    ]
    offers = Offer(places[0], 0.1), Offer(places[1], 0.11)
    seen = World(spec(1), offers=offers, events=tuple(events), now=NOW + 3600)
    assert [x.offer.placement.zone for x in seen.plan().launches] == ["b"]
    later = replace(seen, now=NOW + 30 * 86_400)
    assert [x.offer.placement.zone for x in later.plan().launches] == ["a"]


@pytest.mark.parametrize("pool", ["a", "b", "c", "d"])
def test_a_place_that_refused_often_comes_after_one_that_did_not(pool):
    """Long enough ago that neither rests; what else is equal is drawn by lot, by pool."""
    places = [Placement("c", "r", zone, "m") for zone in ("a", "b")]
    refused = [
        Event(NOW - 9000 + 60 * n + after_s, kind, 0, n, "c/r/a", Reason(Cause.CAPACITY))
        for n in range(1, 5)
        for after_s, kind in enumerate((EventKind.LAUNCH, EventKind.REFUSED))
    ]
    asked = World(replace(spec(1), name=pool), offers=tuple(Offer(place, 0.1) for place in places))
    seen = replace(asked, events=tuple(refused))
    assert [x.offer.placement.zone for x in seen.plan().launches] == ["b"]


def test_of_equal_places_no_name_is_preferred():
    places = [Placement("c", "r", zone, "m") for zone in "abcd"]
    offers = tuple(Offer(place, 0.1) for place in places)
    pools = [
        World(replace(spec(1), name=f"pool{n}"), offers=offers).plan().launches for n in range(40)
    ]
    assert {launch.offer.placement.zone for [launch] in pools} == set("abcd")


@pytest.mark.parametrize("wanted", [2, 4])
@pytest.mark.parametrize("is_held", [False, True])
def test_where_two_were_lost_lately_a_stand_in_is_held_in_place_of_one(wanted, is_held):
    losses = 1 + is_held
    gone = [
        Event(NOW - 400 * age_of, kind, 7, age_of + 1, PLACES[2].location)
        for age_of in range(losses)
        for kind in (EventKind.LAUNCH, EventKind.GONE)
    ]
    of = replace(MIXED, replicas=wanted)
    spots = [replica(slot, of=of, age_s=9000.0) for slot in range(wanted - 1)]
    asked = world(*spots, stand_in(age_s=9000.0), of=of)
    asked = replace(asked, events=(*gone, *asked.events))
    assert ordered(asked) == [(wanted - 1, True)] * (not is_held)
    later = replace(asked, now=NOW + OFTEN_S)
    assert ordered(later) == [(wanted - 1, True)]


@pytest.mark.parametrize(("stands_in_for_s", "goes"), [(300.0, False), (900.0, True)])
def test_under_a_cap_without_room_for_both_a_stand_in_makes_way_for_spot(stands_in_for_s, goes):
    """One spot machine at 0.1 serves and the stand-in at 0.3: a second one fits in its place."""
    capped = replace(MIXED, max_usd_per_hour=0.45)
    planned = world(spot(0), stand_in(age_s=stands_in_for_s), of=capped).plan()
    assert not planned.launches
    assert [id.slot for id in planned.draining] == [STAND_INS] * goes


def test_a_stand_in_that_serves_alone_makes_way_for_nobody():
    capped = replace(MIXED, max_usd_per_hour=0.35)
    planned = world(stand_in(age_s=9000.0), of=capped).plan()
    assert not planned.draining
    assert not planned.terminations


@pytest.mark.parametrize("cap", [None, 5.0, 0.45])
def test_a_stand_in_stays_while_no_spot_machine_can_be_had(cap):
    """Every location refused a second ago: to end the stand-in would win nothing."""
    refused = [
        event
        for number, place in enumerate(PLACES, 1)
        for event in (
            Event(NOW - 2, EventKind.LAUNCH, 1, number, place.location),
            Event(NOW - 1, EventKind.REFUSED, 1, number, reason=Reason(Cause.CAPACITY)),
        )
    ]
    asked = world(spot(0), stand_in(age_s=9000.0), of=replace(MIXED, max_usd_per_hour=cap))
    planned = replace(asked, events=(*asked.events, *refused)).plan()
    assert not planned.draining
    assert not planned.terminations
