"""Delivers a request's outcome to its caller: a replica's response, the fallback's, empty or none.

Owns: calls of the fallback service. Not here: when it is asked (`requests.fallback`).
"""

import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

from fogft.counters import worth_logging
from fogft.errors import RosError
from fogft.metrics.outcomes import Outcome
from fogft.model.spec import OnTimeout, ServiceSpec
from fogft.proxy.robot.ledger import Ledger
from fogft.requests.decide import Pending
from fogft.requests.fallback import FallbackTimer
from fogft.requests.load import NEVER
from fogft.requests.pending import POISON_DEATHS
from fogft.ros.port import RosClient

log = logging.getLogger(__name__)

Respond = Callable[[Any, bytes], None]


@dataclass(eq=False)
class Delivery:
    """The delivery of one service's outcomes; arguments as for `Dispatcher`.

    `forget` tells the given replicas that a request is no longer needed.
    """

    ledger: Ledger
    respond: Respond
    empty_response: bytes | None
    forget: Callable[[bytes, Iterable[int]], None]

    def __post_init__(self) -> None:
        self._client: RosClient | None = None
        self.adopt(self.ledger.spec, None)

    def adopt(self, spec: ServiceSpec, client: RosClient | None) -> None:
        """Apply a spec's fallback and its client, or stop calling one. Call under the lock."""
        was, self._client, requests = self._client, client, self.ledger.requests
        if requests.fallback is None and spec.fallback is not None:
            requests.fallback = FallbackTimer(spec.fallback)
        elif requests.fallback is not None:
            if client is not was:
                requests.fallback.not_asked()
            old = requests.fallback.spec
            unasked = replace(old, after_s=None, while_none_ready=False)
            requests.fallback.spec = spec.fallback or unasked

    def give(self, pending: Pending, payload: bytes) -> None:
        """Send a response to its caller. A failure affects no other request."""
        try:
            self.respond(pending.handle, payload)
        except RosError as error:
            self._warn("undelivered", "response_undelivered", error.message)

    def poisoned(self, request: bytes, pending: Pending) -> None:
        """End a request that crashed several services, in the way set for its deadline."""
        self.ledger.outcomes.poisoned_at = time.time()
        empty = self.ledger.spec.on_timeout is OnTimeout.EMPTY
        outcome = Outcome.FALLBACK if self._falls_back else Outcome.POISON
        self._end(request, pending, outcome, self.empty_response if empty else None)

    def expired(self, request: bytes, pending: Pending, *, may_fall_back: bool = True) -> None:
        """Handle a request's deadline."""
        spec, response = self.ledger.spec, pending.rejection
        if self._falls_back and may_fall_back:
            outcome = Outcome.FALLBACK
        elif response is not None:
            outcome = Outcome.ANSWERED
        elif spec.on_timeout is OnTimeout.EMPTY and self.empty_response is not None:
            outcome, response = Outcome.EMPTY, self.empty_response
        else:
            outcome = Outcome.SILENT
        log.warning(
            "request_timed_out service=%s outcome=%s waited_s=%.3f open=%s request=%s",
            spec.name, outcome.value, self.ledger.clock() - pending.arrived,
            sorted(pending.open), request.hex(),
        )  # fmt: skip
        self._end(request, pending, outcome, response)

    @property
    def _falls_back(self) -> bool:
        """Whether the fallback answers requests past their deadline."""
        falls_back = self.ledger.spec.on_timeout is OnTimeout.FALLBACK
        return falls_back and self.ledger.requests.fallback is not None

    def _end(
        self, request: bytes, pending: Pending, outcome: Outcome, response: bytes | None
    ) -> None:
        """End a request that no replica has answered, or leave it to the fallback."""
        if outcome is Outcome.FALLBACK:
            self._await_fallback(request, pending)
            return
        with self.ledger.lock:
            self.ledger.end(request, pending, outcome)
            if self.ledger.requests.fallback is not None:  # which may still expect the request
                self.ledger.requests.fallback.ended(request)
        if response is not None:
            self.give(pending, response)

    def tick(self, now: float, *, able: bool) -> float:
        """Call the fallback for due requests, end overdue ones; return when to call again."""
        timer, requests = self.ledger.requests.fallback, self.ledger.requests
        if timer is None:
            return NEVER
        with self.ledger.lock:
            due = [(request, requests.get(request)) for request in timer.due(now, able=able)]
            over = timer.given_up(now)
            look_at = timer.look_at(able=able)
        for request, pending in due:
            if pending is not None and not self._ask(request, pending):
                with self.ledger.lock:
                    timer.failed(request)
        for request, pending in over:
            self._without_fallback(request, pending)
        return look_at

    def _await_fallback(self, request: bytes, pending: Pending) -> None:
        """Leave a request to the fallback, and call it unless its call is open already."""
        timer = self.ledger.requests.fallback
        assert timer is not None
        with self.ledger.lock:
            must_ask = timer.expired(request, pending, self.ledger.clock())
        if must_ask and not self._ask(request, pending):
            with self.ledger.lock:
                ours = timer.answered(request) is not None
            if ours:
                self._without_fallback(request, pending)

    def _ask(self, request: bytes, pending: Pending) -> bool:
        """Call the fallback service; return whether it could be called."""
        client = self._client
        try:
            if client is not None and client.available():
                payload = pending.payload
                client.call(payload, lambda response: self._fallback_answered(request, response))
                return True
            reason = "no node offers it"
        except RosError as error:
            reason = error.message
        self._warn("fallback_failed", "fallback_not_asked", reason)
        return False

    def _fallback_answered(self, request: bytes, payload: bytes) -> None:
        """Take the fallback's response, on the thread that receives from ROS."""
        ledger = self.ledger
        accepts = ledger.requests.decide.accepts
        try:
            ok = accepts is None or accepts(payload)
        except RosError:
            ok = False
        with ledger.lock:
            pending, overdue = ledger.requests.fallback_answered(request, ledger.clock(), ok=ok)
            if not ok:
                ledger.outcomes.count["fallback_failed"] += 1
            elif pending is not None:
                ledger.end(request, pending, Outcome.FALLBACK)
        if pending is None:
            return  # a replica was first
        if not ok:
            self._without_fallback(request, pending)
            return
        self.give(pending, payload)
        if not overdue:
            self.forget(request, tuple(pending.open))

    def _without_fallback(self, request: bytes, pending: Pending) -> None:
        """End a request without the fallback's answer: return the rejection if there is one."""
        response = pending.rejection
        unanswered = Outcome.POISON if pending.deaths >= POISON_DEATHS else Outcome.SILENT
        outcome = unanswered if response is None else Outcome.ANSWERED
        self._end(request, pending, outcome, response)

    def _warn(self, counter: str, event: str, reason: str) -> None:
        with self.ledger.lock:
            self.ledger.outcomes.count[counter] += 1
            count = self.ledger.outcomes.count[counter]
        if worth_logging(count):
            name = self.ledger.spec.name
            log.warning("%s service=%s reason=%r count=%d", event, name, reason, count)
