"""Updates of whole pools by seed: never too few answer, and a bad version never stays."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from fogft.model.spec import HealthSpec, PoolSpec
from tests.nightly import by_day
from tests.simulation.test_pools import PLACES, kill_the_manager, preempt, recover
from tests.simulation.world import SERVICE, UID, World

WRONGS = ["crashes", "hangs", "errs"]


def make_world(seed: int, *, replicas: int | None = None, tight: bool = False) -> World:
    """Return a world that is whole with a good version."""
    chance = random.Random(f"update {seed}")
    count = replicas or chance.randint(1, 4)
    spec = PoolSpec(
        name="sim",
        services=(SERVICE,),
        replicas=count,
        max_usd_per_hour=0.1 * count + 0.05 if tight else None,
        health=HealthSpec(start_limit_s=60.0),
        task={"run": "good"},
        migration=False,
    )
    world = World(seed, spec, PLACES[:3])
    for zone in world.cloud.zones.values():
        zone.usd_per_hour = 0.1
    recover(world)
    return world


def apply(world: World, run: str, wrong: str = "") -> str:
    """Apply a file with another `run`; return its version."""
    world.store.the_spec = replace(world.store.the_spec, task={"run": run})
    world.store.edits += 1
    version = world.store.the_spec.replica_hash
    if wrong:
        world.broken[version] = wrong
    return version


def well(world: World) -> int:
    """Count the replicas that answer, and answer right."""
    members = world.store.published.members if world.store.published else ()
    return sum(world.serves(m.id) and world.wrong(m.id) == "" for m in members)


def live(world: World, steps: int, floor: int) -> None:
    """Let time pass; never fewer than `floor` answer well."""
    for _ in range(steps):
        world.tick()
        world.check_now()
        assert well(world) >= floor, [m.id.short for m in world.truth()]
        world.step(world.random.choice([0.3, 1.0, 1.0, 2.0]))


def versions(world: World) -> set[str]:
    return set(world.versions().values())


@pytest.mark.parametrize("seed", range(by_day(8, at_night=200)))
def test_never_fewer_answer_while_new_comes_before_old(seed: int) -> None:
    """With room for both, an update takes away nothing, and ends with the new version good."""
    world = make_world(seed)
    version = apply(world, "better")
    live(world, 250, floor=world.wanted())
    recover(world)
    assert versions(world) == {version}
    assert world.store.the_good == world.store.the_spec


@pytest.mark.parametrize("seed", range(by_day(8, at_night=200)))
def test_one_fewer_answers_at_most_while_old_goes_before_new(seed: int) -> None:
    """Without room for both, all but one answer, and at least one; the update comes to its end."""
    world = make_world(seed, replicas=2 + seed % 3, tight=True)
    version = apply(world, "better")
    live(world, 400, floor=max(1, world.wanted() - 1))
    recover(world)
    assert versions(world) == {version}


@pytest.mark.parametrize("tight", [False, True])
@pytest.mark.parametrize("wrong", WRONGS)
@pytest.mark.parametrize("seed", range(by_day(3, at_night=40)))
def test_a_bad_version_is_given_up_and_the_good_one_restored(seed, wrong, tight) -> None:
    """Whatever is wrong with it, the bad version goes, once and for good, and few ever ran it."""
    replicas = 2 + seed % 3
    world = make_world(seed, replicas=replicas, tight=tight)
    good = world.store.the_spec.replica_hash
    bad = apply(world, "bad", wrong)
    live(world, 300, floor=replicas - 1 if tight or wrong == "errs" else replicas)
    recover(world)
    assert world.store.the_trial.fault
    assert versions(world) == {good}
    launched = list(world.cloud.calls.launched)
    assert sum(order.spec_hash == bad for order in orders(world)) == 1
    live(world, 200, floor=replicas)
    assert list(world.cloud.calls.launched) == launched, "it was tried again"


def orders(world: World) -> list:
    return [vm.order for vm in world.cloud.vms.values() if vm.order.id.pool_uid == UID]


@pytest.mark.parametrize("seed", range(by_day(3, at_night=40)))
def test_the_next_changed_file_is_tried_and_the_same_one_too_if_another_came_between(seed) -> None:
    world = make_world(seed, replicas=2)
    apply(world, "bad", "crashes")
    live(world, 200, floor=2)
    assert world.store.the_trial.fault
    version = apply(world, "better")
    live(world, 200, floor=2)
    assert not world.store.the_trial.fault
    assert versions(world) == {version}


@pytest.mark.parametrize("seed", range(by_day(12, at_night=400)))
def test_faults_meanwhile_change_nothing_about_where_it_ends(seed: int) -> None:
    """Preemptions and killed managers: the pool ends whole, with one version, never the bad one."""
    world = make_world(seed, tight=seed % 4 == 0, replicas=2 + seed % 2)
    good = world.store.the_spec.replica_hash
    wrong = world.random.choice(["", *WRONGS])
    bad = apply(world, "next", wrong)
    for _ in range(150):
        if world.random.random() < 0.04:
            world.random.choice([preempt, kill_the_manager, kill_the_manager])(world)
        world.tick()
        world.check_now()
        world.step(1.0)
    world.kill_in = None
    for _ in range(200):
        world.tick()
        world.step(1.0)
    recover(world)
    assert len(versions(world)) == 1
    assert versions(world) == {good} if wrong else versions(world) <= {good, bad}


def test_a_first_version_that_is_bad_has_nothing_to_go_back_to() -> None:
    """No file was ever good: the manager goes on trying, as a pool's first start does."""
    spec = PoolSpec("sim", (SERVICE,), replicas=2, health=HealthSpec(start_limit_s=60.0),
                    task={"run": "bad"})  # fmt: skip
    world = World(3, spec, PLACES[:3])
    world.broken[spec.replica_hash] = "crashes"
    for _ in range(100):
        world.tick()
        world.step(1.0)
    assert world.store.the_good is None
    assert not world.store.the_trial.fault
