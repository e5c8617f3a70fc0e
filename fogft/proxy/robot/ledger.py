"""The ledger of one service on the robot: its requests and counters, and the lock on them."""

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from fogft.metrics.outcomes import Outcome, Outcomes
from fogft.model.replica import short
from fogft.model.spec import ServiceSpec
from fogft.requests.decide import Pending, Trace
from fogft.requests.pending import PendingRequests

_TRACE_KEPT = 20_000  # lines kept until they are written, once a second


class Ledger:
    """One service's requests and counters. Used under `lock`, which is held only briefly."""

    def __init__(
        self, spec: ServiceSpec, requests: PendingRequests, clock: Callable[[], float]
    ) -> None:
        self.lock = threading.Lock()
        self.requests = requests
        self.outcomes = Outcomes()
        self.clock = clock
        self.traced: deque[dict[str, Any]] | None = None  # how each request ended
        self.adopt(spec)

    def adopt(self, spec: ServiceSpec) -> None:
        """Switch to another policy."""
        self.spec = spec
        if spec.trace != (self.traced is not None):
            self.traced = deque(maxlen=_TRACE_KEPT) if spec.trace else None

    def end(self, request: bytes, pending: Pending, outcome: Outcome) -> None:
        """Count the outcome of a request that ended, and trace it."""
        self.outcomes.count[outcome] += 1
        self.trace(request, pending, outcome, self.clock())

    def trace(
        self, request: bytes, pending: Pending, outcome: Outcome, now: float, replica: str = ""
    ) -> None:
        """Record how and when a request ended, if the service is traced."""
        if self.traced is None:
            return
        arrived, trace = pending.arrived, pending.trace or Trace({}, {})
        self.traced.append(
            {
                "at": now,
                "request": request.hex(),
                "outcome": outcome.value,
                "replica": replica,
                "took_s": round(now - arrived, 6),
                "asked": {short(key): round(at - arrived, 6) for key, at in trace.asked.items()},
                "refused": {short(key): reason.value for key, reason in trace.refused.items()},
            }
        )
