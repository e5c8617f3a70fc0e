"""The client proxy's requests of one service, with their callers and counters.

Owns: the lock under which they are. Not here: what happens to them (`dispatcher`).
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from fogft.metrics.outcomes import Outcome, Outcomes
from fogft.model.refusal import Refusal
from fogft.model.spec import ServiceSpec
from fogft.requests.decide import Pending
from fogft.requests.pending import PendingRequests

_TRACE_KEPT = 20_000  # lines until they are written, once a second


class RequestTrace(NamedTuple):
    """The replicas asked for a traced request. Times on the dispatcher's clock, in seconds."""

    asked: dict[int, float]  # each replica that took it, and when it was asked first
    refused: dict[int, Refusal]  # each replica that refused it, and its last reason


class Request:
    """A caller's request, and its trace if it has one. `arrived` is on the dispatcher's clock."""

    __slots__ = ("arrived", "handle", "payload", "trace")

    def __init__(self, payload: bytes, handle: Any, arrived: float, *, traced: bool) -> None:
        self.payload = payload
        self.handle = handle
        self.arrived = arrived
        self.trace = RequestTrace({}, {}) if traced else None


class Ledger:
    """One service's requests and counters. Used under `lock`, which is held for moments only."""

    def __init__(
        self, spec: ServiceSpec, requests: PendingRequests[Request], clock: Callable[[], float]
    ) -> None:
        self.lock = threading.Lock()
        self.requests = requests
        self.outcomes = Outcomes()
        self.clock = clock
        self.adopt(spec)

    def adopt(self, spec: ServiceSpec) -> None:
        """Switch to another policy."""
        self.spec = spec
        if spec.trace != (self.outcomes.trace is not None):
            self.outcomes.trace = deque(maxlen=_TRACE_KEPT) if spec.trace else None

    def end(self, request: bytes, pending: Pending[Request], outcome: Outcome) -> None:
        """Count the outcome of a request without a replica's answer."""
        self.outcomes.count[outcome] += 1
        self.trace(request, pending, outcome, self.clock())

    def trace(
        self,
        request: bytes,
        pending: Pending[Request],
        outcome: Outcome,
        now: float,
        *,
        replica: str = "",
    ) -> None:
        """Trace a request's outcome, if enabled."""
        if self.outcomes.trace is None:
            return
        arrived, trace = pending.item.arrived, pending.item.trace or RequestTrace({}, {})
        asked = {key: begun - arrived for key, begun in trace.asked.items()}
        self.outcomes.note(
            request,
            outcome,
            took_s=now - arrived,
            at=now,
            asked=asked,
            refused=trace.refused,
            replica=replica,
        )
