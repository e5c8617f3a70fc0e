"""Prometheus metrics of the manager and the rendezvous, and the manager's counters.

Owns: what counts as a launch, a preemption, a loss, a failure, and how long launches take.
Not here: the history that outlives the manager (`fogft.pool.folder.history_file`), and the
proxies' metrics (`fogft.metrics.proxies`).
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from fogft.metrics.proxies import by_event
from fogft.metrics.scrape import family, histogram
from fogft.model.reason import NOTICES, Cause
from fogft.model.replica import Phase
from fogft.planning.observed.history import Event, EventKind
from fogft.pool.manager.status import PoolStatus, ReplicaStatus

if TYPE_CHECKING:
    from prometheus_client import Metric

# Upper bounds of buckets, seconds: from the local cloud to a VM with a long `setup`.
BUCKETS_S = (1.0, 5.0, 15.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1200.0, 3600.0)
_PHASES = ("provisioning", "starting", "total")


class Tally:
    """Counts events as they are recorded, and times each launch. For one thread."""

    def __init__(self) -> None:
        self._launches: Counter[str] = Counter({"spot": 0, "on_demand": 0})
        self._lost: Counter[str] = Counter({"preempted": 0, "gone": 0})
        self._refused: Counter[str] = Counter()
        self._failed: Counter[str] = Counter()
        self._preempted: set[str] = set()
        self._ordered: dict[str, tuple[float, bool]] = {}
        self._running: dict[str, float] = {}
        self._took = {phase: [0] * (len(BUCKETS_S) + 1) for phase in _PHASES}  # launches by bucket
        self._took_s = dict.fromkeys(_PHASES, 0.0)

    def heard(self, event: Event) -> None:
        """Count an event."""
        replica = f"{event.slot}.{event.generation}"
        if event.kind is EventKind.LAUNCH:
            self._launches["on_demand" if event.on_demand else "spot"] += 1
            self._ordered[replica] = event.at, not event.on_demand
            why = event.reason
            if why is not None and any(one.cause in NOTICES for one in why.because):
                self._preempt(why.replica)
        elif event.kind is EventKind.REFUSED:
            self._refused[_cause(event)] += 1
        elif event.kind is EventKind.FAILED:
            self._failed[_cause(event)] += 1
        elif event.kind is EventKind.GONE:
            self._preempt(replica)
        elif event.kind is EventKind.READY and replica in self._ordered:
            self._time(replica, event.at)
        if event.kind in (EventKind.GONE, EventKind.ENDED, EventKind.REFUSED):
            self._ordered.pop(replica, None)
            self._running.pop(replica, None)

    def seen(self, replicas: Iterable[ReplicaStatus], now: float) -> None:
        """Note the running machines, to time the phases before `starting`."""
        for one in replicas:
            replica = f"{one.slot}.{one.generation}"
            if replica in self._ordered and one.phase != Phase.PROVISIONING.value:
                self._running.setdefault(replica, now)

    def _preempt(self, replica: str) -> None:
        """Count a spot machine as preempted, any other one as gone; each once."""
        if replica in self._preempted:
            return
        is_spot = self._ordered.get(replica, (0.0, True))[1]
        self._lost["preempted" if is_spot else "gone"] += 1
        self._preempted.add(replica)

    def _time(self, replica: str, ready_at: float) -> None:
        ordered_at, _ = self._ordered[replica]
        running_at = self._running.pop(replica, ready_at)
        if running_at < 0:
            return  # it was ready before
        for phase, began, ended in (
            ("provisioning", ordered_at, running_at),
            ("starting", running_at, ready_at),
            ("total", ordered_at, ready_at),
        ):
            took_s = max(0.0, ended - began)
            self._took[phase][bisect_left(BUCKETS_S, took_s)] += 1
            self._took_s[phase] += took_s
        self._running[replica] = -1.0

    def metrics(self) -> Iterator[Metric]:
        """Yield the counters."""
        for name, help, label, counts in (
            ("launches", "Machines ordered.", "market", self._launches),
            ("refused_launches", "Orders refused by a cloud, by cause.", "cause", self._refused),
            ("failed_launches", "Launches that failed, by cause.", "cause", self._failed),
            ("lost_replicas", "Machines lost without being ended by fogft.", "kind", self._lost),
        ):
            told = [(n, {label: key}) for key, n in list(counts.items())]  # others may be added
            yield family(f"fogft_pool_{name}_total", help, told)
        yield histogram(
            "fogft_pool_launch_duration_seconds",
            "Time from the order to a running machine, from there to ready, and in total.",
            BUCKETS_S,
            ((took, self._took_s[phase], {"phase": phase}) for phase, took in self._took.items()),
        )


def _cause(event: Event) -> str:
    return event.reason.cause.value if event.reason is not None else Cause.ERROR.value


def of_pool(status: PoolStatus | None, tally: Tally) -> Iterator[Metric]:
    """Yield the metrics of a pool's last status; none before the first."""
    yield from tally.metrics()
    if status is None:
        return
    known = {
        "fogft_pool_target_replicas": ("Replicas to keep ready.", status.target),
        "fogft_pool_ready_replicas": ("Replicas that answer and are to be kept.", status.ready),
        "fogft_pool_usd_per_hour": ("Price of all machines together.", status.usd_per_hour),
        "fogft_pool_cloud_reachable": (
            "Whether the cloud could list its machines.",
            status.cloud_reachable,
        ),
        "fogft_pool_proxy_alive": ("Whether the client proxy reports.", status.proxy_alive),
        "fogft_pool_uplink_suspected": (
            "Whether all links have fallen silent together.",
            status.uplink_suspected,
        ),
        "fogft_pool_stopping": ("Whether the pool is being shut down.", status.stopping),
        "fogft_pool_observed_timestamp_seconds": (
            "When the manager last observed the pool, in Unix time.",
            status.observed_at,
        ),
        "fogft_manager_epoch": ("Number of the manager, higher for each new one.", status.epoch),
        "fogft_pool_usd_total": ("Cost of the pool so far.", status.usd_to_date),
    }
    for name, (help, value) in known.items():
        yield family(name, help, [(value, {})])
    ends_at = status.credentials_end_at
    yield family(
        "fogft_credentials_left_seconds",
        "Time until the cloud's credentials expire, where known.",
        [] if ends_at is None else [(ends_at - status.observed_at, {})],
    )
    phases = Counter(replica.phase for replica in status.replicas)
    yield family(
        "fogft_pool_replicas",
        "Replicas by phase.",
        ((phases[one.value], {"phase": one.value}) for one in Phase),
    )
    yield family(
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
    help = "Members that are connected."
    yield family("fogft_rendezvous_callers", help, [(report["callers"], {})])
    yield family("fogft_rendezvous_records", "Records held.", [(report["records"], {})])
    yield by_event("fogft_rendezvous_port_events_total", "Events at its port.", report["port"])
    yield by_event("fogft_rendezvous_messages_total", "Messages by kind.", report["messages"])
    yield by_event(
        "fogft_rendezvous_offers_total", "Records offered, by verdict.", report["offered"]
    )
