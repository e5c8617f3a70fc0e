"""What the manager and the rendezvous tell Prometheus.

Owns: names and labels of their metrics. Not here: those of proxies (`fogft.metrics.proxies`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from fogft.metrics.families import counter, gauge
from fogft.metrics.proxies import by_event
from fogft.model.replica import Phase
from fogft.pool.manager.status import PoolStatus
from fogft.pool.manager.tally import Tally

if TYPE_CHECKING:
    from prometheus_client import Metric


def of_pool(status: PoolStatus | None, tally: Tally) -> Iterator[Metric]:
    """Yield the metrics of a pool as its manager last saw it; none before the first time."""
    yield from tally.metrics()
    if status is None:
        return
    gauges = {
        "fogft_pool_target_replicas": ("Replicas to keep ready.", status.target),
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
        "fogft_pool_stopping": ("Whether the pool is being shut down.", status.stopping),
        "fogft_pool_observed_timestamp_seconds": (
            "When the manager last looked, since the epoch.",
            status.observed_at,
        ),
        "fogft_manager_epoch": ("Which manager of the pool this is.", status.epoch),
    }
    for name, (help, value) in gauges.items():
        yield gauge(name, help, [(value, {})])
    ends_at = status.credentials_end_at
    yield gauge(
        "fogft_credentials_left_seconds",
        "Until the cloud's credentials end, where that is known.",
        [] if ends_at is None else [(ends_at - status.observed_at, {})],
    )
    yield counter("fogft_pool_usd_total", "What the pool has cost.", [(status.usd_to_date, {})])
    phases = Counter(replica.phase for replica in status.replicas)
    yield gauge(
        "fogft_pool_replicas",
        "Replicas by phase.",
        ((phases[one.value], {"phase": one.value}) for one in Phase),
    )
    yield gauge(
        "fogft_replica_info",
        "Which machine fills a slot.",
        (
            (
                1,
                {
                    "slot": str(replica.slot),
                    "generation": str(replica.generation),
                    "location": replica.location,
                    "instance": replica.instance,
                    "spot": str(replica.spot).lower(),
                },
            )
            for replica in status.replicas
        ),
    )


def of_rendezvous(report: Mapping[str, Any]) -> Iterator[Metric]:
    """Yield the metrics of a rendezvous from its report."""
    yield gauge("fogft_rendezvous_callers", "Who is connected.", [(report["callers"], {})])
    yield gauge("fogft_rendezvous_records", "Records it holds.", [(report["records"], {})])
    yield by_event("fogft_rendezvous_port_events_total", "Events at its port.", report["port"])
    yield by_event("fogft_rendezvous_messages_total", "Messages by kind.", report["messages"])
    yield by_event(
        "fogft_rendezvous_offers_total", "Records offered, by verdict.", report["offered"]
    )
