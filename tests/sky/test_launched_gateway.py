"""A pool that launches its own gateway: replicas come after it, and follow it elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from fogft.cloud.port import Launch
from fogft.cloud.sky.naming import replica_of
from fogft.model.groups import GATEWAY_SLOT
from fogft.model.replica import Offer, ReplicaId
from fogft.model.spec import PoolSpec
from fogft.model.topology import LaunchedGateway as Asked
from fogft.planning.gateway import version
from fogft.planning.observed.clock_jumps import Reading
from fogft.pool.manager.launched_gateway import LaunchedGateway
from fogft.pool.manager.reconciler import Reconciler
from tests.sky.pool_on_sky import UID, PoolOnSky


def order(spec: PoolSpec, offer: Offer, generation: int) -> Launch:
    id = ReplicaId(UID, GATEWAY_SLOT, generation)
    place = replace(offer.placement, spot=False)
    return Launch(id, "perception", place, offer.usd_per_hour, version(spec))


@pytest.fixture
def pool(tmp_path: Path) -> PoolOnSky:
    made = PoolOnSky(tmp_path, gateway=Asked(launch=True))

    def place(host: str) -> None:
        made.store.the_spec = made.store.the_spec.behind(host)

    def is_up(now: float) -> bool:
        there = any(i.id.slot == GATEWAY_SLOT for i in made.scene.provider.found.values())
        return made.connected and there

    def new_manager(epoch: int = 2) -> Reconciler:
        return Reconciler(
            made.scene.cloud,
            made.store,
            clock=lambda: Reading(*[made.scene.now] * 3),
            links=lambda uid, now: made.links(uid, now) if made.watched else None,
            epoch=epoch,
            gateway=LaunchedGateway(made.scene.cloud, is_up, order, place),
        )

    made.connected = made.watched = True
    made.new_manager = new_manager
    made.manager = new_manager(1)
    made.until(made.ready)
    return made


def ordered(pool: PoolOnSky) -> list[str]:
    """Return the replicas that were launched, in order."""
    return [id.short for one in pool.sky.launched if (id := replica_of(one.name))]


def test_the_gateway_is_launched_first(pool: PoolOnSky):
    assert ordered(pool) == ["1999.1", "0.1"]
    assert pool.store.the_spec.dial_in.endswith(":7472")
    assert [judged.id.short for judged in pool.tick().plan.health.replicas] == ["0.1"]


def test_one_that_is_lost_is_missed_at_once_and_no_replica_dials_its_address(pool: PoolOnSky):
    """A replica that is launched before there is another would never serve."""
    before, lost_at = pool.store.the_spec.dial_in, pool.scene.now
    pool.sky.boots = False
    pool.sky.preempt(next(name for name in pool.sky.records if "-1999-" in name))
    pool.until(lambda: "1999.2" in ordered(pool))
    assert pool.scene.now - lost_at < 10
    asked = len(pool.sky.asked("refresh"))
    pool.tick(60)
    assert len(pool.sky.asked("refresh")) == asked, "one that boots is left alone"
    assert "0.2" not in ordered(pool)
    pool.sky.boots = True
    pool.until(lambda: pool.ready() == ["0.2"])
    assert ordered(pool) == ["1999.1", "0.1", "1999.2", "0.2"]
    assert pool.store.the_spec.dial_in != before


@pytest.mark.parametrize("what", ["reboot", "sleep", "no report"])
def test_silence_that_nobody_listened_to_ends_no_gateway(pool: PoolOnSky, what: str):
    """All replicas would be replaced after it, while nobody is served."""
    pool.tick(100)
    pool.connected = False
    if what == "reboot":  # the robot's links come after its manager
        pool.kill_the_manager()
        pool.manager = pool.new_manager()
    elif what == "sleep":
        pool.scene.pass_s(600)
    else:
        pool.watched = False
        pool.tick(70)
    pool.tick(3)
    pool.connected = pool.watched = True
    pool.tick(60)
    assert ordered(pool) == ["1999.1", "0.1"]
    pool.connected = False
    pool.until(lambda: "1999.2" in ordered(pool), limit=200)
