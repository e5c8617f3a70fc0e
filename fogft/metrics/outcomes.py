"""Outcomes of one service's requests: counters, latencies and first responses.

All methods are called under the dispatcher's lock, except `late`, which has its own.
"""

import bisect
import threading
from collections import defaultdict, deque
from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum
from typing import Any

from fogft.model.refusal import Effect, Refusal
from fogft.model.replica import short

_LATENCIES_KEPT = 2000
_GONE_KEPT = 100  # replicas
# Upper bounds of the histogram's buckets, seconds: from a local call to a slow planner.
BUCKETS_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
OUTCOMES_COUNTED = (
    *("received", "sent", "answered", "late", "rejected", "silent", "empty"),
    *("fallback", "fallback_failed", "turned_away", "undelivered", "cancelled", "poison"),
    *("request_bytes", "response_bytes"),
)


class Outcome(str, Enum):
    """How a request ended."""

    ANSWERED = "answered"  # by a replica
    FALLBACK = "fallback"  # by the fallback service
    EMPTY = "empty"  # with the default response
    SILENT = "silent"  # with no response
    TURNED_AWAY = "turned_away"  # it was not accepted
    CANCELLED = "cancelled"  # its caller withdrew it
    POISON = "poison"  # services crashed while they worked on it


@dataclass
class OfReplica:
    """A replica's counts of first responses, and of good and bad answers."""

    won: int = 0
    well: int = 0
    ill: int = 0


class Outcomes:
    """Counts since the start, described by `metrics.proxies`. Replicas are `ReplicaId.key`."""

    def __init__(self) -> None:
        self.count = dict.fromkeys(OUTCOMES_COUNTED, 0)
        self.refused: dict[str, int] = {}
        self.of: defaultdict[int, OfReplica] = defaultdict(OfReplica)
        self._latencies: deque[float] = deque(maxlen=_LATENCIES_KEPT)
        self._buckets = [0] * (len(BUCKETS_S) + 1)
        self._took_s = 0.0
        self._late_lock = threading.Lock()
        # When a request was last given up because services crashed on it; wall clock.
        self.poisoned_at: float | None = None

    def won(self, replica: int, took_s: float, size_bytes: int) -> None:
        """Count a replica's first response, and its size."""
        self.count["answered"] += 1
        self.count["response_bytes"] += size_bytes
        ended = self.of[replica]
        ended.won += 1
        ended.well += 1
        self._latencies.append(took_s)
        self._buckets[bisect.bisect_left(BUCKETS_S, took_s)] += 1
        self._took_s += took_s

    def refusal(self, reason: Refusal, replica: int | None = None) -> None:
        """Count a refusal, also against the replica if its service is at fault."""
        self.refused[reason.value] = self.refused.get(reason.value, 0) + 1
        if replica is not None and Effect.FAULT in reason.effect:
            self.of[replica].ill += 1

    def rejected(self, replica: int) -> None:
        """Count a valid response whose `ok_field` was false."""
        self.count["rejected"] += 1
        self.of[replica].ill += 1

    def keep(self, replicas: Collection[int]) -> None:
        """Keep the counts of these replicas; of all others, only the latest."""
        for gone in [key for key in self.of if key not in replicas][:-_GONE_KEPT]:
            del self.of[gone]

    def late(self) -> None:
        """Count an answer that came too late to be used. Any thread; takes no other lock."""
        with self._late_lock:
            self.count["late"] += 1

    def report(self) -> dict[str, Any]:
        """Return counters and latencies in seconds; ``buckets`` are those of `BUCKETS_S`."""
        ordered = sorted(self._latencies)
        return {
            **self.count,
            "refused": dict(self.refused),
            "won": {short(key): one.won for key, one in self.of.items() if one.won},
            "poisoned_at": self.poisoned_at,
            "p50_s": ordered[len(ordered) // 2] if ordered else None,
            "p99_s": ordered[int(len(ordered) * 0.99)] if ordered else None,
            "buckets": list(self._buckets),
            "took_s": self._took_s,
        }
