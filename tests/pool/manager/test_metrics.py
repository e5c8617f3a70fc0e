"""What the manager tells Prometheus of a pool."""

from __future__ import annotations

from dataclasses import replace

from fogft.model.reason import Cause, Reason
from fogft.planning.observed.history import Event, EventKind
from fogft.pool.manager import tally
from fogft.pool.manager.tally import Tally
from tests.fakes.pools import STATUS
from tests.fakes.threads import meanwhile
from tests.metrics.samples import text


def test_a_pool_is_told_as_its_status_says():
    said = text(tally.of_pool(STATUS, Tally()), {"pool": STATUS.pool}).splitlines()
    assert f'fogft_pool_ready_replicas{{pool="{STATUS.pool}"}} {STATUS.ready:.1f}' in said
    assert f'fogft_pool_target_replicas{{pool="{STATUS.pool}"}} {STATUS.target:.1f}' in said
    for phase in ("ready", "starting", "draining", "gone"):
        count = sum(replica.phase == phase for replica in STATUS.replicas)
        line = f'fogft_pool_replicas{{phase="{phase}",pool="{STATUS.pool}"}} {count:.1f}'
        assert line in said


def test_before_the_first_tick_only_counters_are_told():
    told = {family.name for family in tally.of_pool(None, Tally())}
    assert "fogft_pool_launches" in told
    assert "fogft_pool_ready_replicas" not in told


def test_the_end_of_credentials_and_the_cost_are_told_where_they_are_known():
    said = text(tally.of_pool(STATUS, Tally()), {"pool": STATUS.pool})
    assert "fogft_credentials_left_seconds{" not in said
    known = replace(STATUS, credentials_end_at=STATUS.observed_at + 90, usd_to_date=1.5)
    said = text(tally.of_pool(known, Tally()), {"pool": STATUS.pool})
    assert f'fogft_credentials_left_seconds{{pool="{STATUS.pool}"}} 90.0' in said
    assert f'fogft_pool_usd_total{{pool="{STATUS.pool}"}} 1.5' in said


def test_events_are_counted_while_metrics_are_told():
    for _ in range(20):
        counting = Tally()

        def count(counting=counting) -> None:
            for cause in Cause:
                counting.heard(Event(0.0, EventKind.REFUSED, 0, 1, reason=Reason(cause)))

        meanwhile(count, lambda counting=counting: list(counting.metrics()))
        (refused,) = [m for m in counting.metrics() if m.name == "fogft_pool_refused_launches"]
        assert len(refused.samples) == len(Cause)
