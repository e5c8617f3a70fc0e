"""Pools on a cloud whose list is from memory, as SkyPilot's is: it must be asked again."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fogft.errors import CloudUnreachable
from fogft.model import intent as intents
from tests.nightly import by_day
from tests.simulation.test_pools import FAULTS, PLACES, live_through_faults, make_world, recover
from tests.simulation.world import UID, RememberingCloud, World


def whole_world(seed: int, replicas: int) -> World:
    spec = replace(make_world(0).spec, replicas=replicas, max_usd_per_hour=None, max_surge=1)
    world = World(seed, spec, PLACES, RememberingCloud)
    world.deferred = False
    world.manager = world.new_manager(1)
    recover(world)
    return world


def ours(world: World) -> list:
    return [m for m in world.truth() if m.id.pool_uid == UID]


@pytest.mark.parametrize("seed", range(by_day(20, at_night=500)))
def test_laws_hold_and_the_pool_becomes_whole(seed: int) -> None:
    """As on any cloud: what the list does not know yet breaks no law."""
    world = make_world(seed, RememberingCloud)
    live_through_faults(world, FAULTS)
    recover(world)
    assert world.whole()


def test_a_lost_replica_is_replaced_as_soon_as_its_link_is_silent() -> None:
    """One tick asks, the next one launches; nobody waits for `replace_after_s`."""
    world = whole_world(1, replicas=2)
    lost, kept = ours(world)
    world.cloud.preempt(lost.id)
    before = len(world.cloud.calls.launched)
    silent_since = world.now
    while len(world.cloud.calls.launched) == before:
        world.step(0.5)
        world.tick()
        assert world.now < silent_since + 30
    health = world.spec.health
    assert world.now - silent_since <= health.suspect_after_s + 1.5
    assert health.replace_after_s > health.suspect_after_s + 1.5
    (replacement,) = (m for m in ours(world) if m.id != kept.id)
    assert replacement.id.slot == lost.id.slot
    assert replacement.placement.location != lost.placement.location


def test_a_whole_pool_lost_at_once_is_replaced_though_it_looks_like_a_dead_uplink() -> None:
    """All links are silent together: only the cloud can tell the one from the other."""
    world = whole_world(2, replicas=3)
    for machine in ours(world):
        world.cloud.preempt(machine.id)
    assert recover(world) <= 60


def test_a_dead_uplink_alone_replaces_nothing() -> None:
    """The cloud is asked, less and less often, and says that all are there."""
    world = whole_world(3, replicas=3)
    launched = list(world.cloud.calls.launched)
    world.cloud.refreshed.clear()
    world.uplink_down = True
    for _ in range(600):
        world.tick()
        world.step(1.0)
    assert world.cloud.calls.launched == launched
    for machine in ours(world):
        assert 5 <= world.cloud.refreshed.count(machine.id) <= 20


def test_a_cloud_that_cannot_tell_is_asked_again_and_nothing_is_concluded() -> None:
    """An error is not an answer."""
    world = whole_world(4, replicas=2)
    launched = len(world.cloud.calls.launched)
    for machine in ours(world):  # the uplink takes the provider's interface with it
        world.cloud.fail_next("refresh", CloudUnreachable("no route"))
        world.frozen.add(machine.id)
    for _ in range(20):
        world.tick()
        world.step(1.0)
    assert len(world.cloud.calls.launched) == launched
    assert world.cloud.refreshed


def test_a_machine_lost_while_it_is_set_up_is_noticed() -> None:
    """It never answered, so no silence tells: it is asked about from time to time."""
    world = whole_world(5, replicas=1)
    world.store.the_intent = intents.scale(world.store.the_intent, world.spec, 1, 0.0)
    world.tick()
    young = max(ours(world), key=lambda m: m.launched_at)
    world.frozen.add(young.id)  # it is set up, and nothing listens yet
    for _ in range(20):
        world.tick()
        world.step(1.0)
    assert young.id in world.member_ids()
    world.cloud.preempt(young.id)
    for _ in range(50):
        world.tick()
        world.step(1.0)
    assert young.id in world.cloud.refreshed
    assert len(ours(world)) == 2
