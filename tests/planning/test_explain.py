"""`fogft plan`: what a pool would be, whatever happened to the one that runs."""

from __future__ import annotations

from fogft.model.choices import OnDemandSpec
from fogft.planning.explain import explain
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
