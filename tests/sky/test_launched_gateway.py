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
        return any(i.id.slot == GATEWAY_SLOT for i in made.scene.provider.found.values())

    made.manager = Reconciler(
        made.scene.cloud,
        made.store,
        clock=lambda: Reading(*[made.scene.now] * 3),
        links=made.links,
        gateway=LaunchedGateway(made.scene.cloud, is_up, order, place),
    )
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
