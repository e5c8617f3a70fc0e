"""Somebody sets the robot's clock while a pool lives: nothing is launched or ended for it."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from fogft.model.reason import Cause, Reason
from fogft.planning.observed.history import OF_NO_REPLICA, Event, EventKind
from tests.nightly import by_day
from tests.simulation.test_pools import FAULTS, PLACES, kill_the_manager, make_world, recover
from tests.simulation.world import START, UID, World

DAY_S = 86_400.0
JUMPS_S = (-400 * DAY_S, -DAY_S, -3600.0, -61.0, -6.0, 6.0, 61.0, 3600.0, DAY_S, 400 * DAY_S)


def lived(seed: int, jumps: bool) -> World:
    """Let a pool live through faults, with a clock that is right or one that is set at random."""
    world = make_world(seed)
    chance = random.Random(f"clock {seed}")
    faults = [fault for fault in FAULTS if fault is not kill_the_manager]
    mends = []
    for step in range(100):
        if world.random.random() < 0.25:
            mends.append((step + world.random.choice([5, 30]), world.random.choice(faults)(world)))
        for _, mend in [one for one in mends if one[0] == step and one[1] is not None]:
            mend()
        if chance.random() < 0.1 and jumps:
            world.clock_ahead_s += chance.choice(JUMPS_S)
        world.tick()
        world.check_now()
        world.step(world.random.choice([1.0, 1.0, 3.0]))
    return world


def launched(world: World) -> int:
    return sum(id.pool_uid == UID for id in world.cloud.calls.launched)


def happened(world: World) -> list[tuple[object, ...]]:
    """Return what happened, without the time of day."""
    return [
        (e.kind, e.slot, e.generation, e.location, e.reason)
        for e in world.store.events
        if e.kind not in OF_NO_REPLICA
    ]


@pytest.mark.parametrize("seed", range(by_day(6, at_night=100)))
def test_a_pool_lives_the_same_life_whatever_the_clock_says(seed: int) -> None:
    """Launch for launch and end for end, through preemptions, silence, refusals and edits."""
    still, jumping = lived(seed, jumps=False), lived(seed, jumps=True)
    assert happened(jumping) == happened(still)
    assert any(e.kind is EventKind.CLOCK for e in jumping.store.events)


@pytest.mark.parametrize("ahead_s", JUMPS_S)
def test_a_launch_under_way_is_not_late_because_the_clock_was_set(ahead_s: float) -> None:
    """Provisioning or starting: it is waited for exactly as long as without the jump."""
    for slow in ("boots", "starts"):
        world = World(1, replace(make_world(0).spec, replicas=1, max_usd_per_hour=None), PLACES)
        if slow == "boots":
            for zone in world.cloud.zones.values():
                zone.boot_s = (40.0, 40.0)
        else:
            world.start_s = 40.0
        for second in range(58):
            if second == 20:
                world.clock_ahead_s += ahead_s
            tick = world.tick()
            if second == 21:
                assert tick is not None
                assert any(note.cause is Cause.CLOCK_DOUBTED for note in tick.plan.notes)
            world.step(1.0)
        assert launched(world) == 1
        assert not world.cloud.calls.terminated
        assert world.whole()


@pytest.mark.parametrize("ahead_s", JUMPS_S)
def test_a_launch_that_hangs_is_late_all_the_same(ahead_s: float) -> None:
    """However far back the clock was set: later by that at most, and by the limit at most."""
    world = World(1, replace(make_world(0).spec, replicas=1, max_usd_per_hour=None), PLACES)
    for zone in world.cloud.zones.values():
        zone.boot_s = (9_999.0, 9_999.0)
    for second in range(126):
        if second == 20:
            world.clock_ahead_s += ahead_s
        world.tick()
        world.step(1.0)
    assert launched(world) >= 2


def test_the_next_manager_counts_from_what_was_moved() -> None:
    """What is written down is enough: a manager that was killed after the jump is no different."""
    world = make_world(3)
    recover(world)
    world.clock_ahead_s = -3600.0
    world.tick()
    before = launched(world), len(world.cloud.calls.terminated)
    world.kill_in = 1
    for _ in range(30):
        world.tick()
        world.step(1.0)
    assert (launched(world), len(world.cloud.calls.terminated)) == before
    set_at = [e for e in world.store.events if e.kind is EventKind.CLOCK]
    assert set_at == [
        Event(set_at[0].at, EventKind.CLOCK, 0, 0, "", set_at[0].reason, by_s=-3600.0)
    ]
    assert set_at[0].reason == Reason(Cause.CLOCK_SET, seconds=-3600.0)


BOOTS_WITH_S = (0.0, -3600.0, -400 * DAY_S, 1.0 - START)
"""How far the clock is ahead as a robot boots, until it hears the time: in 1970 at worst."""


def rebooted(world: World, ahead_s: float) -> None:
    """Have the next manager start with a clock that is wrong, and set right soon after."""
    world.clock_ahead_s = ahead_s
    world.store.reopen()
    world.manager = world.new_manager(2)
    for _ in range(3):
        world.tick()
        world.step(1.0)
    world.clock_ahead_s = 0.0


@pytest.mark.parametrize("ahead_s", BOOTS_WITH_S)
@pytest.mark.parametrize("slow", ["boots", "starts"])
def test_a_launch_that_hangs_is_late_although_the_robot_boots_with_an_old_clock(slow, ahead_s):
    """What was remembered by the right time is not of decades ahead once that is known again."""
    world = World(1, replace(make_world(0).spec, replicas=1, max_usd_per_hour=None), PLACES)
    for zone in world.cloud.zones.values():
        zone.boot_s = (9_999.0, 9_999.0) if slow == "boots" else zone.boot_s
    world.start_s = 9_999.0
    for second in range(126):
        if second == 10:
            rebooted(world, ahead_s)
        world.tick()
        world.step(1.0)
    assert launched(world) >= 2


@pytest.mark.parametrize("ahead_s", BOOTS_WITH_S)
def test_a_full_location_rests_although_the_robot_booted_with_an_old_clock(ahead_s: float) -> None:
    """A location proves itself now or earlier, and not in decades."""
    world = World(1, replace(make_world(0).spec, replicas=1, max_usd_per_hour=None), PLACES[:1])
    for _ in range(60):
        world.tick()
        world.step(1.0)
    rebooted(world, ahead_s)
    world.tick()
    for zone in world.cloud.zones.values():
        zone.capacity = 0
    [ours] = [machine.id for machine in world.truth() if machine.id.pool_uid == UID]
    world.cloud.preempt(ours, notice_s=0.0)
    for _ in range(300):
        world.tick()
        world.step(1.0)
    assert 1 <= sum(e.kind is EventKind.REFUSED for e in world.store.events) <= 8
