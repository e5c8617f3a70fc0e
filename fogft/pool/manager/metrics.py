"""What the manager and the rendezvous tell Prometheus. Pure.

Owns: names and labels of their metrics. Not here: those of proxies (`fogft.metrics.proxies`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from fogft.metrics.exposition import COUNTER, GAUGE, Family, Sample, of
from fogft.model.replica import Phase
from fogft.pool.manager.status import PoolStatus


def of_pool(status: PoolStatus | None) -> list[Family]:
    """Return the metrics of a pool as its manager last saw it; none before the first time."""
    if status is None:
        return []
    phases = Counter(replica.phase for replica in status.replicas)
    gauges = {
        "fogft_pool_target_replicas": ("Replicas that are wanted.", status.target),
        "fogft_pool_ready_replicas": ("Replicas that answer and are to stay.", status.ready),
        "fogft_pool_usd_per_hour": ("Price of all machines together.", status.usd_per_hour),
        "fogft_pool_cloud_reachable": (
            "Whether the cloud could say what exists.",
            status.cloud_reachable,
        ),
        "fogft_pool_proxy_alive": ("Whether the client proxy reports.", status.proxy_alive),
        "fogft_pool_uplink_suspected": (
            "Whether all links have fallen silent together.",
            status.uplink_suspected,
        ),
        "fogft_pool_stopping": ("Whether the pool is being ended.", status.stopping),
        "fogft_pool_observed_seconds": ("When this was seen, since the epoch.", status.observed_at),
        "fogft_manager_epoch": ("Which manager of the pool this is.", status.epoch),
    }
    pool = {"pool": status.pool}
    return [
        *(of(name, GAUGE, help, [Sample(value, pool)]) for name, (help, value) in gauges.items()),
        of(
            "fogft_pool_replicas",
            GAUGE,
            "Replicas by phase.",
            [Sample(phases[one.value], {**pool, "phase": one.value}) for one in Phase],
        ),
    ]


def of_rendezvous(report: Mapping[str, Any]) -> list[Family]:
    """Return the metrics of a rendezvous from its report."""
    counts = {
        "fogft_rendezvous_port_events_total": ("Events at its port.", report["port"]),
        "fogft_rendezvous_messages_total": ("Messages by kind.", report["messages"]),
        "fogft_rendezvous_offers_total": ("Records offered, by verdict.", report["offered"]),
    }
    return [
        of("fogft_rendezvous_callers", GAUGE, "Who is connected.", [Sample(report["callers"])]),
        of("fogft_rendezvous_records", GAUGE, "Records it holds.", [Sample(report["records"])]),
        *(
            of(name, COUNTER, help, [Sample(n, {"event": str(event)}) for event, n in by.items()])
            for name, (help, by) in counts.items()
        ),
    ]
