"""What the manager tells Prometheus of a pool."""

from __future__ import annotations

from fogft.metrics.families import text
from fogft.pool.manager import metrics
from tests.cli.pools import STATUS


def test_a_pool_is_told_as_its_status_says():
    said = text(metrics.of_pool(STATUS), {"pool": STATUS.pool}).splitlines()
    assert f'fogft_pool_ready_replicas{{pool="{STATUS.pool}"}} {STATUS.ready:.1f}' in said
    assert f'fogft_pool_target_replicas{{pool="{STATUS.pool}"}} {STATUS.target:.1f}' in said
    for phase in ("ready", "starting", "draining", "gone"):
        count = sum(replica.phase == phase for replica in STATUS.replicas)
        line = f'fogft_pool_replicas{{phase="{phase}",pool="{STATUS.pool}"}} {count:.1f}'
        assert line in said


def test_before_the_first_tick_nothing_is_told():
    assert list(metrics.of_pool(None)) == []
