"""On-demand machines that are stopped while spot is there, and started when it is lost again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from fogft.cloud.sky.naming import cluster_name
from fogft.errors import CloudError, CloudUnreachable
from fogft.model.choices import OnDemandSpec
from fogft.model.replica import Offer
from tests.fakes.sky import EAST, WEST, replica
from tests.sky.pool_on_sky import PoolOnSky

ON_DEMAND = replace(WEST, spot=False)
STANDBY = replica(100)


@pytest.fixture
def pool(tmp_path: Path) -> PoolOnSky:
    """A pool whose stand-in has made way for a spot machine."""
    made = PoolOnSky(tmp_path, on_demand=OnDemandSpec(fallback=True, standbys=1))
    made.sky.sold = [Offer(EAST, 0.02, "catalogue"), Offer(ON_DEMAND, 0.1, "catalogue")]
    made.until(lambda: made.ready() == ["0.1"])
    lose_spot(made)
    made.until(lambda: made.ready() == ["100.1"])
    made.sky.full.clear()
    made.until(lambda: stopped(made), limit=3000)
    return made


def lose_spot(pool: PoolOnSky) -> None:
    pool.sky.full.add("aws/us-east-1/us-east-1a")
    (spot,) = [name for name in pool.sky.records if "-0-" in name]
    pool.scene.sky.preempt(spot)
    pool.scene.cloud.refresh(next(m.id for m in pool.scene.machines() if m.id.slot == 0))


def stopped(pool: PoolOnSky) -> list[str]:
    return [m.id.short for m in pool.scene.machines() if m.phase.value == "stopped"]


def test_a_stand_in_is_stopped_when_spot_is_back_and_started_when_it_is_lost(pool: PoolOnSky):
    """Not bought anew: it is the same machine, under the same id, and costs its disk meanwhile."""
    assert (stopped(pool), pool.sky.asked("stop")) == (["100.1"], [cluster_name(STANDBY)])
    tick = pool.tick(30)
    assert (tick.plan.launches, tick.plan.terminations) == ((), ())
    (standby,) = tick.observed.standbys
    assert standby.usd_per_hour == pytest.approx(0.007, abs=1e-3)
    orders = pool.sky.asked("launch").count(cluster_name(STANDBY))
    lose_spot(pool)
    pool.until(lambda: pool.ready() == ["100.1"])
    assert pool.sky.asked("launch").count(cluster_name(STANDBY)) == orders + 1
    assert not [name for name in pool.sky.records if "-100-2" in name or "-101-" in name]


def test_one_whose_start_skypilot_does_not_answer_is_not_taken_for_a_failed_launch(pool: PoolOnSky):
    """The request of its first launch has long ended; this one was heard."""
    pool.sky.fail_next("launch", CloudUnreachable("no answer within 120 s"), 1)
    lose_spot(pool)
    pool.until(lambda: not stopped(pool))
    pool.tick(60)
    assert not [name for name in pool.sky.records if "-100-2" in name or "-101-" in name]
    assert "100.1" in [m.id.short for m in pool.scene.machines()]


def test_one_that_has_started_before_skypilot_is_asked_for_its_request_serves(pool: PoolOnSky):
    """The answer to its order was lost."""
    name = cluster_name(STANDBY)
    before = pool.sky.asked("launch").count(name)
    pool.sky.fail_next("launch-heard", CloudUnreachable("no answer within 120 s"))
    lose_spot(pool)
    pool.until(lambda: pool.sky.asked("launch").count(name) > before, seconds=0.1)
    pool.sky.finish(name)
    pool.until(lambda: pool.ready() == ["100.1"], limit=100)


def test_what_cannot_be_stopped_is_ended(tmp_path: Path):
    made = PoolOnSky(tmp_path, on_demand=OnDemandSpec(fallback=True, standbys=1))
    made.sky.sold = [Offer(EAST, 0.02, "catalogue"), Offer(ON_DEMAND, 0.1, "catalogue")]
    made.sky.fail_next("stop", CloudError("this cloud stops no machines"))
    made.until(lambda: made.ready() == ["0.1"])
    lose_spot(made)
    made.until(lambda: made.ready() == ["100.1"])
    made.sky.full.clear()
    made.until(lambda: "100.1" not in made.running(), limit=3000)
    assert not stopped(made)


def test_a_standby_of_another_file_or_of_none_ends(pool: PoolOnSky):
    """It would run what is no longer wanted."""
    pool.change(task={**pool.spec.task, "run": "serve --newer"})
    pool.until(lambda: not stopped(pool))
    assert "100.1" not in pool.running()


def test_fewer_standbys_are_kept_when_the_file_says_so(pool: PoolOnSky):
    pool.change(on_demand=OnDemandSpec(fallback=True))
    pool.until(lambda: not stopped(pool))
    assert "100.1" not in pool.running()


def test_a_new_manager_goes_on_to_shut_them_down(pool: PoolOnSky):
    """`down` was cut short after it had written that the pool is to end."""
    pool.store.the_intent = replace(pool.store.the_intent, stopping=True)
    pool.kill_the_manager()
    pool.until(lambda: not pool.scene.machines())


def test_a_manager_that_died_finds_them(pool: PoolOnSky):
    pool.kill_the_manager()
    lose_spot(pool)
    pool.until(lambda: pool.ready() == ["100.1"])
