"""Who moves in a pool that is whole and quiet: what spares work changes no plan."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from fogft.model.choices import OnDemandSpec
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Offer
from fogft.planning import migration
from fogft.planning.buying import Buyer
from fogft.planning.classification import classify
from fogft.planning.observed.health import judge
from fogft.planning.observed.history import Event, EventKind
from fogft.planning.sizing import Inputs, size
from tests.planning.pool_worlds import NOW, PLACES, UID, World, applied, replica, spec

PRICES = st.sampled_from([0.02, 0.1, 0.2, 0.5])
WANTED = st.integers(1, 4)
ON_DEMAND = st.sampled_from([OnDemandSpec(), OnDemandSpec(1, False), OnDemandSpec(0, True)])


@st.composite
def quiet(draw: st.DrawFn) -> World:
    """A pool in which all serve, each somewhere, with places that refused and lost some."""
    asked = spec(
        draw(WANTED),
        max_surge=draw(st.integers(0, 2)),
        max_usd_per_hour=draw(st.sampled_from([None, None, 0.5])),
        on_demand=draw(ON_DEMAND),
    )
    sold = [
        Offer(replace(place, spot=spot), draw(PRICES))
        for place in PLACES
        for spot in (True, False)
        if draw(st.booleans())
    ]
    homes = st.sampled_from([replace(p, spot=spot) for p in PLACES for spot in (True, True, False)])
    world = World(asked, offers=tuple(sold)).having(
        *(
            replica(
                slot,
                at=draw(homes),
                age_s=draw(st.sampled_from([100.0, 5000.0])),
                price=draw(PRICES),
                of=asked,
            )
            for slot in range(asked.replicas)
        )
    )
    past = []
    for generation in range(1, draw(st.integers(0, 4)) + 1):
        at, place = NOW - draw(st.floats(1, 4000)), draw(st.sampled_from(PLACES))
        kind = draw(st.sampled_from([EventKind.REFUSED, EventKind.GONE]))
        past.append(Event(at, EventKind.LAUNCH, 9, generation, place.location))
        past.append(Event(at, kind, 9, generation, "", Reason(Cause.CAPACITY)))
    return replace(world, events=tuple(sorted((*world.events, *past), key=lambda e: e.at)))


def buyer(world: World) -> Buyer:
    """What the planner asks who is to move."""
    health = judge(UID, world.spec, world.observed, world.history)
    inputs = Inputs(world.spec, world.intent, world.observed, world.history)
    sized = size(inputs)
    return Buyer(inputs, classify(inputs, health, sized), sized)


@given(quiet())
def test_nobody_moves_who_would_not_if_nothing_rested_or_were_avoided(world: World) -> None:
    """To ask the restless alone who moves, and where to, is to ask everybody."""
    asked = buyer(world)
    everybody = [replica.id for replica in asked.machines.good]
    found = migration.mover(asked, world.now, everybody)
    narrowed = migration.mover(asked, world.now, migration.restless(asked))
    assert found == narrowed


@given(quiet())
def test_a_move_under_way_leaves_nothing_to_plan(world: World) -> None:
    """Who moves is not ended, and nobody else comes, before the successor serves."""
    planned = world.plan()
    again = applied(world, planned).plan()
    assert not again.launches
    assert not again.terminations
    assert set(again.draining) == set(planned.draining)


@given(quiet(), quiet(), st.booleans())
def test_what_was_planned_before_changes_no_plan(
    world: World, other: World, same_offers: bool
) -> None:
    """An answer that is kept is that of the same question: another pool's history is none."""
    asked_before = replace(other, spec=world.spec)
    if same_offers:
        asked_before = replace(asked_before, offers=world.offers)
    asked_before.plan()
    world.plan()
    fresh = replace(world, spec=replace(world.spec))
    assert world.plan() == fresh.plan()


def test_calmer_places_are_moved_to_and_restless_ones_are_not_for_spread_alone() -> None:
    """Both replicas are in one zone. Ten losses in a day speak against another region."""
    one = spec(2)
    here, elsewhere = PLACES[0], PLACES[-1]
    offers = tuple(Offer(place, 0.1) for place in (here, elsewhere))
    world = World(one, offers=offers).having(
        *(replica(slot, at=here, age_s=9000.0, price=0.1, of=one) for slot in (0, 1))
    )
    assert [x.offer.placement for x in world.plan().launches] == [elsewhere]
    lost = [
        Event(NOW - 90_000 + 7000 * n + after_s, kind, 9, n + 1, elsewhere.location)
        for n in range(10)
        for after_s, kind in ((0, EventKind.LAUNCH), (100, EventKind.READY), (900, EventKind.GONE))
    ]
    assert not replace(world, events=(*lost, *world.events)).plan().launches
    lone = replace(one, replicas=1)
    there = World(lone, offers=offers).having(replica(0, at=elsewhere, age_s=9000.0, of=lone))
    assert [
        x.offer.placement for x in replace(there, events=(*lost, *there.events)).plan().launches
    ] == [here]
