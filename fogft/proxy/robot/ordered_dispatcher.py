"""One stateful service on the robot: number each request, return the first answer.

The same ways in and out as `dispatcher.Dispatcher`. Decisions are those of its `ServiceOrder`;
here are its lock, its clock, and the callers who wait. Orders leave in the order in which they
were made: `_sending` is held from `take` to the last `offer`.

Owns: callers and their deadlines. Not here: numbers and terms (`service_order`), links.
Protocol: docs/design/state.md.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from fogft.errors import RosError
from fogft.link.port import Answer, Link
from fogft.log_limits import worth_logging
from fogft.metrics.outcomes import Outcomes
from fogft.model.refusal import Refusal
from fogft.model.replica import ReplicaId
from fogft.model.spec import OnTimeout, ServiceSpec
from fogft.ordering.orders import Op, OrderError, OrderId, decode, encode
from fogft.ordering.peer import Order
from fogft.proxy.order_mark import MarkFile
from fogft.proxy.robot.dispatcher import key_of
from fogft.proxy.robot.service_order import ServiceOrder
from fogft.requests.hedging import NEVER

log = logging.getLogger(__name__)

# An order is not given up at its caller's deadline: it must be applied all the same.
_ATTEMPT_S = 60.0
# Orders that have the service called: what they end with speaks for or against the replica.
_COPIES = (Op.APPLY,)


class _Caller:
    """Who waits for an answer."""

    __slots__ = ("arrived", "deadline", "handle", "payload", "size")

    def __init__(self, payload: bytes, handle: Any, arrived: float, deadline: float) -> None:
        self.payload = payload  # let go of once it is numbered: the log has it
        self.size = len(payload)
        self.handle = handle
        self.arrived = arrived
        self.deadline = deadline


class OrderedDispatcher:
    """The requests of one stateful service, from the caller's request to its response.

    Args:
        spec: The service and its policy.
        respond: Sends a response to the caller of a handle. Any thread.
        mark: What survives this process.
        empty_response: The serialised default response, for ``on_timeout: empty``.
        wake: Has `tick` called soon. Any thread.
        clock: Monotonic seconds.
        max_waiting_bytes: Requests kept while no replica can take them, in bytes; more are
            turned away and counted.
        max_waiting: The same, by number.
    """

    def __init__(
        self,
        spec: ServiceSpec,
        respond: Callable[[Any, bytes], None],
        mark: MarkFile,
        *,
        empty_response: bytes | None = None,
        wake: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
        max_waiting_bytes: int = 64 << 20,
        max_waiting: int = 1 << 16,
    ) -> None:
        self.spec = spec
        self._respond = respond
        self._mark = mark
        self._empty_response = empty_response
        self._wake = wake
        self._clock = clock
        self._max_waiting_bytes = max_waiting_bytes
        self._max_waiting = max_waiting
        self._lock = threading.Lock()
        self._sending = threading.Lock()
        self._links: dict[int, Link] = {}
        self._numbered: dict[int, _Caller] = {}
        self._early: deque[_Caller] = deque()
        self._early_bytes = 0
        self._outcomes = Outcomes()
        self._trouble = self._told = ""
        self._order = ServiceOrder(spec.name, mark)

    # -- requests -------------------------------------------------------------------------

    @property
    def able(self) -> bool:
        """Whether a replica can answer now."""
        return self._order.ready

    def burst(self, begins: bool) -> None:
        """Do nothing: each request is put in order, and sent, by itself."""

    def submit(self, payload: bytes, handle: Any) -> None:
        """Take a caller's request, number it, and order it applied by every replica."""
        now = self._clock()
        caller = _Caller(payload, handle, now, now + self.spec.timeout_s)
        count = self._outcomes.count
        with self._lock:
            self._outcomes.received(len(payload))
            if self._early or not self._number(caller):
                bytes_over = self._early_bytes + len(payload) > self._max_waiting_bytes
                if bytes_over or len(self._early) >= self._max_waiting:
                    count["turned_away"] += 1
                    turned_away = count["turned_away"]
                    if worth_logging(turned_away):
                        log.warning(
                            "request_turned_away service=%s reason=%r count=%d",
                            self.spec.name, "no replica takes requests", turned_away,
                        )  # fmt: skip
                    return
                self._early.append(caller)
                self._early_bytes += len(payload)
        self._send()

    def _number(self, caller: _Caller) -> bool:
        """Give a request its number, if a replica can take it now. Under the lock."""
        number = self._order.submit(caller.payload)
        if number is None:
            return False
        caller.payload = b""
        self._numbered[number] = caller
        return True

    def _send(self) -> None:
        """Send what is to be sent. Not from a link's callback."""
        with self._sending:
            with self._lock:
                orders, links = self._order.take(), self._links
            for epoch, order in orders:
                self._offer(order, epoch, links)

    def _offer(self, order: Order, epoch: int, links: dict[int, Link]) -> None:
        link = links.get(order.replica)
        id = encode(order.op, epoch, order.index)
        limit_s = max(_ATTEMPT_S, 4 * self.spec.timeout_s)
        if link is not None and link.offer(self.spec.name, id, order.payload, limit_s):
            if order.op in _COPIES:
                self._outcomes.count["sent"] += 1
            return
        with self._lock:
            self._order.declined(
                order.replica, (order.op, epoch, order.index), self._clock()
            )  # fmt: skip

    def answered(self, link: Link, answer: Answer) -> None:
        """Take the end of an order from a link's thread."""
        try:
            id = decode(answer.request_id)
        except OrderError:  # of the time before this service was stateful
            return
        with self._lock:
            now = self._clock()
            if answer.payload is not None and not self._order.is_current(id):
                return
            payload = self._take_end(link, id, answer, now)
            caller = None if payload is None else self._numbered.pop(id[2], None)
            if caller is not None and payload is not None:
                self._outcomes.won(link.peer.id, now - caller.arrived, len(payload))
            due = self._order.due
        if caller is not None and payload is not None:
            self._return(caller.handle, payload)
        elif id[0] is Op.APPLY and answer.payload is not None:
            self._outcomes.late()
        if due:
            self._wake()

    def _take_end(self, link: Link, id: OrderId, answer: Answer, now: float) -> bytes | None:
        """Pass the end of an order on; return the answer to its number if it is. Under the lock."""
        replica, applies = key_of(link), id[0] in _COPIES
        if answer.payload is not None:
            try:
                answers = self._order.replied(replica, id, answer.payload)
            except OrderError as error:
                log.warning("order_unreadable service=%s reason=%r", self.spec.name, error)
                answer = answer._replace(refusal=Refusal.MALFORMED)
            else:
                if applies:
                    self._outcomes.served(link.peer.id)
                return answer.payload if answers else None
        refusal = answer.refusal or Refusal.LOST
        self._outcomes.refusal(refusal, link.peer.id if applies else None)
        self._order.refused(replica, id, answer, now)
        return None

    def late(self, link: Link, request: bytes) -> None:
        """Nothing is ever forgotten here, so no answer comes too late for its link."""

    def _return(self, handle: Any, payload: bytes) -> None:
        try:
            self._respond(handle, payload)
        except RosError as error:
            with self._lock:
                self._outcomes.count["undelivered"] += 1
                count = self._outcomes.count["undelivered"]
            if worth_logging(count):
                log.warning(
                    "response_undelivered service=%s reason=%r count=%d",
                    self.spec.name, error.message, count,
                )  # fmt: skip

    # -- links and time -------------------------------------------------------------------

    def adopt(self, spec: ServiceSpec) -> None:
        """Follow another policy from now on; requests under way keep their deadlines."""
        with self._lock:
            self.spec = spec

    def route(
        self,
        links: Sequence[Link],
        versions: Mapping[ReplicaId, str] | None = None,
        leaving: Collection[ReplicaId] = (),
    ) -> None:
        """Set the links that are up, whether or not their replica is ready.

        Args:
            links: Them.
            versions: What each replica of the pool runs, reached or not.
            leaving: The replicas that are to go soon.
        """
        with self._lock:
            self._links = {key_of(link): link for link in links}
            known = {
                key: (versions or {}).get(link.peer.id, "") for key, link in self._links.items()
            }
            going = [key for key, link in self._links.items() if link.peer.id in leaving]
            self._order.reach(self._links, self._clock(), known, going)
        self._send()

    def tick(self) -> float:
        """Number what waited, send what is due, let callers' deadlines come. Call at 50 Hz.

        Returns:
            When to call again at the latest: no matter when.
        """
        now = self._clock()
        with self._lock:
            self._order.tick(now)
            expired = self._expired(now)
            while self._early and self._number(self._early[0]):
                self._early_bytes -= self._early.popleft().size
            self._look_for_trouble()
        self._send()
        for caller in expired:
            self._time_out(caller)
        return NEVER

    def _expired(self, now: float) -> list[_Caller]:
        """Take out the callers whose deadline has come. Under the lock."""
        numbered = [i for i, caller in self._numbered.items() if caller.deadline <= now]
        for index in numbered:
            self._order.abandon(index)
        expired = [self._numbered.pop(index) for index in numbered]
        while self._early and self._early[0].deadline <= now:
            self._early_bytes -= self._early[0].size
            expired.append(self._early.popleft())
        return expired

    def _time_out(self, caller: _Caller) -> None:
        empty = self.spec.on_timeout is OnTimeout.EMPTY and self._empty_response is not None
        outcome = "empty" if empty else "silent"
        with self._lock:
            self._outcomes.count[outcome] += 1
        log.warning(
            "request_timed_out service=%s outcome=%s waited_s=%.3f numbered=%s",
            self.spec.name, outcome, self.spec.timeout_s, not caller.payload,
        )  # fmt: skip
        if empty and self._empty_response is not None:
            self._return(caller.handle, self._empty_response)

    def _look_for_trouble(self) -> None:
        trouble = self._order.trouble
        if trouble and trouble != self._told:
            self._told = trouble
            log.error("state_unavailable service=%s reason=%r", self.spec.name, trouble)
        self._trouble = trouble

    # -- what people see ------------------------------------------------------------------

    def won(self, replica: ReplicaId) -> int:
        """Return how many requests a replica has answered first."""
        return self._outcomes.won_by(replica)

    def by(self, replica: ReplicaId) -> tuple[int, int]:
        """Return how many requests a replica has answered well, and how many failed there."""
        return self._outcomes.by(replica)

    def report(self) -> dict[str, Any]:
        """Return counters, latency quantiles (seconds) and the state of the order."""
        with self._lock:
            return {
                **self._outcomes.report(),
                "pending": len(self._numbered) + len(self._early),
                "pending_bytes": self._early_bytes + self._order.held_bytes,
                "order": {**self._order.report(), "trouble": self._trouble},
            }

    def close(self) -> None:
        """Let go of the mark's file. Nothing may be answered afterwards."""
        with self._lock:
            self._numbered.clear()
            self._mark.close()
