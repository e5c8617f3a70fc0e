"""Counts of what happened to a pool's replicas since its manager started, for Prometheus.

Owns: what counts as a launch, a preemption, a loss, a failure, and how long launches take.
Not here: the history that outlives the manager (`fogft.pool.folder.history_file`).
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from fogft.metrics.families import counter, histogram
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Phase
from fogft.planning.observed.history import Event, EventKind
from fogft.pool.manager.status import ReplicaStatus

if TYPE_CHECKING:
    from prometheus_client import Metric

# Upper bounds of buckets, seconds: from the local cloud to a VM with a long `setup`.
BUCKETS_S = (1.0, 5.0, 15.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1200.0, 3600.0)
_PHASES = ("provisioning", "starting", "total")


class Tally:
    """Counts events as they are written, and times each launch. One thread."""

    def __init__(self) -> None:
        self._launches: Counter[str] = Counter({"spot": 0, "on_demand": 0})
        self._lost: Counter[str] = Counter({"preempted": 0, "gone": 0})
        self._refused: Counter[str] = Counter()
        self._failed: Counter[str] = Counter()
        self._preempted: set[str] = set()
        self._ordered: dict[str, tuple[float, bool]] = {}
        self._running: dict[str, float] = {}
        self._took: dict[str, list[float]] = {phase: [] for phase in _PHASES}

    def heard(self, event: Event) -> None:
        """Count an event."""
        replica = f"{event.slot}.{event.generation}"
        if event.kind is EventKind.LAUNCH:
            self._launches["on_demand" if event.on_demand else "spot"] += 1
            self._ordered[replica] = event.at, not event.on_demand
            if event.reason is not None and _is_notice(event.reason):
                self._preempt(event.reason.replica)
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
        """Note which machines run: so long took what comes before `starting`."""
        for one in replicas:
            replica = f"{one.slot}.{one.generation}"
            if replica in self._ordered and one.phase != Phase.PROVISIONING.value:
                self._running.setdefault(replica, now)

    def _preempt(self, replica: str) -> None:
        """Count a spot machine that was taken, once; any other one that went counts as gone."""
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
        self._took["provisioning"].append(max(0.0, running_at - ordered_at))
        self._took["starting"].append(max(0.0, ready_at - running_at))
        self._took["total"].append(max(0.0, ready_at - ordered_at))
        self._running[replica] = -1.0

    def metrics(self) -> Iterator[Metric]:
        """Yield what was counted."""
        for name, help, label, counts in (
            ("launches", "Machines that were ordered.", "market", self._launches),
            ("refused_launches", "Orders that a cloud refused, by cause.", "cause", self._refused),
            ("failed_launches", "Launches that failed, by cause.", "cause", self._failed),
            ("lost_replicas", "Machines that went unasked.", "kind", self._lost),
        ):
            yield counter(
                f"fogft_pool_{name}_total", help, [(n, {label: key}) for key, n in counts.items()]
            )
        yield histogram(
            "fogft_pool_launch_duration_seconds",
            "Time from the order to a running machine, from there to ready, and in total.",
            BUCKETS_S,
            ((_buckets(took), sum(took), {"phase": phase}) for phase, took in self._took.items()),
        )


def _buckets(took: list[float]) -> list[int]:
    counts = [0] * (len(BUCKETS_S) + 1)
    for one in took:
        counts[bisect_left(BUCKETS_S, one)] += 1
    return counts


def _cause(event: Event) -> str:
    return event.reason.cause.value if event.reason is not None else Cause.ERROR.value


def _is_notice(reason: Reason) -> bool:
    return any(one.cause in (Cause.NOTICE, Cause.DRAINS_ITSELF) for one in reason.because)
