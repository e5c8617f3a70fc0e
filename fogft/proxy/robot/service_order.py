"""Orders the requests of one stateful service on a robot, across terms.

The decisions are made in `ordering.sequencer`. This module keeps the numbered requests, those
waiting for a number, and the mark that survives this process. Protocol: docs/design/state.md.
"""

import logging
import secrets
import time
from collections.abc import Callable, Collection
from typing import Any

from fogft.model.refusal import Refusal
from fogft.ordering.orders import Op, OrderError, OrderId, decode, encode
from fogft.ordering.sequencer import Handover, Sequencer
from fogft.proxy.robot.order_mark import OrderMark
from fogft.requests.decide import Decide, Judgement, Means, Pending, Reachable, Send
from fogft.requests.pending import POISON_DEATHS

log = logging.getLogger(__name__)

# An order is not abandoned at its caller's deadline: it must still be applied.
_ATTEMPT_S = 60.0
_DEPOSED_LIMIT = 3  # terms ended by others without an answer: they will go on


class ServiceOrder(Decide):
    """Numbers requests, and decides what to send to which replica and which answers count.

    While `held`, another proxy still orders: requests wait until `take_over`.
    """

    replicates = sends_requests = True

    def __init__(
        self,
        name: str,
        mark: OrderMark,
        *,
        wake: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
        held: bool = False,
    ) -> None:
        super().__init__()
        self._held = held
        self._name = name
        self._mark = mark
        self._wake = wake
        self._clock = clock
        self._replicas = Reachable((), {}, ())
        self._requests: dict[int, bytes] = {}  # by number
        self._numbers: dict[bytes, int] = {}
        self._waiting: dict[bytes, bytes] = {}  # not numbered yet; oldest first
        self._told = ""
        self._deposed = 0  # terms ended by others since the last answer
        self._term = self._begin_term()

    def _begin_term(self, above: int = 0, begin: Handover | None = None) -> Sequencer:
        self._numbers.clear()  # numbered requests of an earlier term are answered, or never will be
        self._requests.clear()
        epoch = self._mark.new_term(secrets.randbits(32), above=above)
        mark = self._mark.position
        log.info("term_began service=%s epoch=%x mark=%d", self._name, epoch, mark.index)
        return Sequencer(epoch, mark=mark, holder=self._mark.holder, begin=begin)

    def hold(self) -> None:
        """Stop ordering: another proxy takes over, and its term ends this one."""
        self._held = True

    def take_over(self, now: float) -> None:
        """Begin a term after the last answer, if another proxy has ordered until now."""
        if self._held:
            self._held, self._term = False, self._begin_term()
            self._reach(now)

    @property
    def held(self) -> Collection[bytes]:
        """Return the requests that wait while another proxy orders."""
        return tuple(self._waiting) if self._held else ()

    @property
    def ready(self) -> bool:
        """Whether a request taken now can be answered."""
        return self._held or self._term.ready

    @property
    def trouble(self) -> str:
        """Why the service is unavailable; empty if it is available."""
        if self._term.held_by:
            return (
                f"robot `{self._term.held_by}` uses this service, and a service with `state` is "
                "for one robot; for several, see docs/how-to/state.md"
            )
        if self._term.stranded:
            return "no reachable replica has the state; see docs/design/state.md"
        if self._deposed >= _DEPOSED_LIMIT and not self._term.ready:
            return (
                "another client proxy keeps ordering its requests with this robot's certificate; "
                "end it, or give that robot its own: see docs/how-to/several-robots.md"
            )
        return ""

    # -- callers' requests ----------------------------------------------------------------

    def began(self, request: bytes, pending: Pending, able: Collection[int]) -> None:
        """Number a request; it waits if no replica can take it."""
        payload = pending.payload
        if self._waiting or not self._number(request, payload):
            self._waiting[request] = payload

    def _number(self, request: bytes, payload: bytes) -> bool:
        number = None if self._held or not self._term.ready else self._term.submit(payload)
        if number is None:
            return False
        self._numbers[request], self._requests[number] = number, request
        return True

    def closed(self, request: bytes, pending: Pending) -> None:
        """Note that no caller awaits the answer any more. Numbered requests are still applied."""
        self._waiting.pop(request, None)
        number = self._numbers.pop(request, None)
        if number is not None:
            del self._requests[number]
            self._term.abandon(number)

    # -- replicas' replies ----------------------------------------------------------------

    def request_of(self, id: bytes) -> bytes | None:
        """Return the request of an order, b"" if it is over; None for an order about no request."""
        try:
            op, epoch, number = decode(id)
        except OrderError:  # an attempt from before this service was stateful
            return None
        if op not in (Op.APPLY, Op.RECALL):
            return None
        return self._requests.get(number, b"") if epoch == self._term.epoch else b""

    def judge(
        self, id: bytes, replica: int, payload: bytes, reading: Any, pending: Pending | None
    ) -> Judgement:
        """Take a reply; if it answers a request, store its position before it is returned."""
        current = self._current(id)
        if current is None:
            return Means.NOTHING
        op, _, number = current
        term = self._term
        try:
            answers = term.replied(replica, op, number, payload)
        except OrderError as error:
            log.warning("order_unreadable service=%s reason=%r", self._name, error)
            self.refused(id, replica, Refusal.MALFORMED, "", pending)
            return Refusal.MALFORMED
        if answers:
            self._deposed = 0
            self._mark.write(term.mark, term.active.version or "")
        self._wake_if_due()
        if answers:
            return Means.SUCCESS
        return Means.LATE if op is Op.APPLY else Means.NOTHING

    def refused(
        self, id: bytes, replica: int, refusal: Refusal, detail: str, pending: Pending | None
    ) -> None:
        """Take a refusal, or the loss of an order."""
        current = self._current(id)
        if current is not None:
            op, _, number = current
            kills = self._term.refused(replica, op, number, refusal, self._clock(), detail=detail)
            if kills and pending is not None:
                pending.deaths = POISON_DEATHS  # so the request is given up
            elif kills:
                log.error("request_poison service=%s number=%d", self._name, number)
        self._wake_if_due()

    def declined(self, id: bytes, replica: int, now: float) -> None:
        """Note that a link did not accept an order."""
        current = self._current(id)
        if current is not None:
            self._term.declined(replica, current[0], current[2], now)

    def _current(self, id: bytes) -> OrderId | None:
        try:
            order = decode(id)
        except OrderError:
            return None
        return None if self._held or order[1] != self._term.epoch else order

    def _wake_if_due(self) -> None:
        if self._term.due:
            self._wake()

    # -- sending --------------------------------------------------------------------------

    def reach(self, replicas: Reachable, now: float) -> None:
        """Set the reachable replicas."""
        self._replicas = replicas
        self._reach(now)

    def _reach(self, now: float) -> None:
        _, versions, draining = self._replicas
        self._term.reach(versions, now, versions=versions, draining=draining)

    def take(self, now: float, timeout_s: float) -> list[Send]:
        """Number the waiting requests, and return the orders to send, in sequence."""
        if self._held:
            return []
        self._tick(now)
        for request, payload in list(self._waiting.items()):
            if not self._number(request, payload):
                break
            del self._waiting[request]
        if (trouble := self.trouble) not in ("", self._told):
            self._told = trouble
            log.error("state_unavailable service=%s reason=%r", self._name, trouble)
        epoch, limit_s = self._term.epoch, max(_ATTEMPT_S, 4 * timeout_s)
        return [
            Send(
                order.replica,
                encode(order.op, epoch, order.index),
                order.payload,
                limit_s,
                order.op is Op.APPLY,
            )
            for order in self._term.take()
        ]

    def _tick(self, now: float) -> None:
        if self._term.deposed_by is not None:  # by a term of ours that is not in the mark's file
            above = self._term.deposed_by
            self._deposed += 1
            log.warning("term_ended service=%s obeyed=%x", self._name, above)
            self._term = self._begin_term(above)
            self._reach(now)
        self._term.tick(now)
        begin = self._term.handover
        if begin is not None:  # every number given is answered, and none waits
            log.info("version_changed service=%s version=%s", self._name, begin.version)
            self._term = self._begin_term(begin=begin)
            self._reach(now)

    def report(self) -> dict[str, Any]:
        """Return the state of the order, as reported in `proxy-status.json`."""
        term = self._term
        log_ = term.log
        order = {
            "epoch": term.epoch >> 32,
            "last": log_.last if log_ else None,
            "joined": len(term.joined),
            "log": len(log_),
            "log_bytes": log_.held_bytes,
            "checkpoint": log_.checkpoint.index if log_ and log_.checkpoint else None,
            "answered": term.mark.index,
            "version": term.active.version or "",
            "trouble": self.trouble,
        }
        return {"order": order}

    def close(self) -> None:
        """Close the mark's file. Nothing may be answered afterwards."""
        self._mark.close()
