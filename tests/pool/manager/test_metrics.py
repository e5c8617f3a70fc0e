"""What the manager and a rendezvous tell Prometheus."""

from __future__ import annotations

from fogft.metrics.exposition import text
from fogft.pool.manager import metrics
from tests.cli.pools import STATUS


def test_a_pool_is_told_as_its_status_says():
    said = text(metrics.of_pool(STATUS)).splitlines()
    assert f'fogft_pool_ready_replicas{{pool="{STATUS.pool}"}} {STATUS.ready}' in said
    assert f'fogft_pool_target_replicas{{pool="{STATUS.pool}"}} {STATUS.target}' in said
    for phase in ("ready", "starting", "draining", "gone"):
        count = sum(replica.phase == phase for replica in STATUS.replicas)
        assert f'fogft_pool_replicas{{pool="{STATUS.pool}",phase="{phase}"}} {count}' in said


def test_before_the_first_tick_nothing_is_told():
    assert text(metrics.of_pool(None)) == ""


def test_a_rendezvous_tells_who_is_there():
    report = {"callers": 2, "records": 5, "port": {"refused": 1}, "messages": {}, "offered": {}}
    said = text(metrics.of_rendezvous(report)).splitlines()
    assert "fogft_rendezvous_callers 2" in said
    assert 'fogft_rendezvous_port_events_total{event="refused"} 1' in said
