"""One stateful service on the robot: number each request, return the first answer.

The same ways in and out as `dispatcher.Dispatcher`. Decisions are the sequencer's; here are its
lock, its clock, its file, and the callers who wait. Orders leave in the order in which the
sequencer made them: `_sending` is held from `take` to the last `offer`.

Owns: callers and their deadlines. Not here: numbers (`fogft.core.sequencer`), links.
Protocol: docs/design/state.md.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from fogft.core import ordering
from fogft.core.errors import RosError
from fogft.core.hedging import NEVER
from fogft.core.model import ReplicaId
from fogft.core.ordering import Op, OrderError
from fogft.core.sequencer import Handover, Order, Sequencer
from fogft.core.spec import OnTimeout, ServiceSpec
from fogft.proxy.dispatcher import key_of
from fogft.proxy.mark import MarkFile
from fogft.proxy.outcomes import Outcomes
from fogft.wire.port import Answer, Link, Refusal

log = logging.getLogger(__name__)

# An order is not given up at its caller's deadline: it must be applied all the same.
_ATTEMPT_S = 60.0


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
    ) -> None:
        self.spec = spec
        self._respond = respond
        self._mark = mark
        self._empty_response = empty_response
        self._wake = wake
        self._clock = clock
        self._max_waiting_bytes = max_waiting_bytes
        self._lock = threading.Lock()
        self._sending = threading.Lock()
        self._links: dict[int, Link] = {}
        self._versions: dict[int, str] = {}
        self._leaving: list[int] = []
        self._numbered: dict[int, _Caller] = {}
        self._early: deque[_Caller] = deque()
        self._early_bytes = 0
        self._outcomes = Outcomes()
        self._trouble = self._told = ""
        self._sequencer = self._begin_term()

    def _begin_term(self, above: int = 0, begin: Handover | None = None) -> Sequencer:
        epoch = self._mark.new_term(secrets.randbits(32), above=above)
        mark = self._mark.position
        log.info("term_began service=%s epoch=%x mark=%d", self.spec.name, epoch, mark.index)
        return Sequencer(epoch, mark=mark, holder=self._mark.holder, begin=begin)

    # -- requests -------------------------------------------------------------------------

    @property
    def able(self) -> bool:
        """Whether a replica can answer now."""
        return self._sequencer.ready

    def submit(self, payload: bytes, handle: Any) -> None:
        """Take a caller's request, number it, and order it applied by every replica."""
        now = self._clock()
        caller = _Caller(payload, handle, now, now + self.spec.timeout_s)
        count = self._outcomes.count
        with self._lock:
            self._outcomes.received(len(payload))
            if self._early or not self._number(caller):
                if self._early_bytes + len(payload) > self._max_waiting_bytes:
                    count["turned_away"] += 1
                    turned_away = count["turned_away"]
                    if turned_away & (turned_away - 1) == 0:  # log the 1st, 2nd, 4th, ...
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
        if not self._sequencer.ready:
            return False
        index = self._sequencer.submit(caller.payload)
        if index is None:
            return False
        caller.payload = b""
        self._numbered[index] = caller
        return True

    def _send(self) -> None:
        """Send what the sequencer has to send. Not from a link's callback."""
        with self._sending:
            with self._lock:
                orders, epoch, links = self._sequencer.take(), self._sequencer.epoch, self._links
            for order in orders:
                self._offer(order, epoch, links)

    def _offer(self, order: Order, epoch: int, links: dict[int, Link]) -> None:
        link = links.get(order.replica)
        id = ordering.encode(order.op, epoch, order.index)
        limit_s = max(_ATTEMPT_S, 4 * self.spec.timeout_s)
        if link is not None and link.offer(self.spec.name, id, order.payload, limit_s):
            if order.op is Op.APPLY:
                self._outcomes.count["sent"] += 1
            return
        with self._lock:
            if epoch == self._sequencer.epoch:
                self._sequencer.declined(order.replica, order.op, order.index, self._clock())

    def answered(self, link: Link, answer: Answer) -> None:
        """Take the end of an order from a link's thread."""
        replica = key_of(link)
        caller = None
        try:
            op, epoch, index = ordering.decode(answer.request_id)
        except OrderError:  # of the time before this service was stateful
            return
        payload = answer.payload
        with self._lock:
            sequencer = self._sequencer
            if epoch != sequencer.epoch:
                return
            now = self._clock()
            if payload is None:
                asked = link.peer.id if op is Op.APPLY else None
                self._outcomes.refusal(answer.refusal.split(":")[0], asked)
                sequencer.refused(replica, op, index, answer.refusal, now)
            else:
                try:
                    first = sequencer.replied(replica, op, index, payload)
                except OrderError as error:
                    log.warning("order_unreadable service=%s reason=%r", self.spec.name, error)
                    sequencer.refused(replica, op, index, Refusal.MALFORMED, now)
                    first = False
                if op is Op.APPLY:
                    self._outcomes.served(link.peer.id)
                if first:
                    # Before anybody sees the answer.
                    self._mark.write(sequencer.mark, sequencer.office.holder or "")
                    caller = self._numbered.pop(index, None)
                if caller is not None:
                    self._outcomes.won(link.peer.id, now - caller.arrived, len(payload))
            ends = sequencer.deposed_by is not None or sequencer.handover is not None
            sends = sequencer.sends or ends or (op is Op.APPLY and sequencer.changing)
        if caller is not None and payload is not None:
            self._return(caller.handle, payload)
        elif op is Op.APPLY and payload is not None:
            self._outcomes.late()
        if sends:
            self._wake()

    def late(self, link: Link, request: bytes) -> None:
        """Nothing is ever forgotten here, so no answer comes too late for its link."""

    def _return(self, handle: Any, payload: bytes) -> None:
        try:
            self._respond(handle, payload)
        except RosError as error:
            with self._lock:
                self._outcomes.count["undelivered"] += 1
                count = self._outcomes.count["undelivered"]
            if count & (count - 1) == 0:
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
            versions: What each replica runs.
            leaving: The replicas that are to go soon.
        """
        with self._lock:
            self._links = {key_of(link): link for link in links}
            self._versions = {
                key: (versions or {}).get(link.peer.id, "") for key, link in self._links.items()
            }
            self._leaving = [k for k, link in self._links.items() if link.peer.id in leaving]
            self._reach(self._clock())
        self._send()

    def _reach(self, now: float) -> None:
        self._sequencer.reach(self._links, now, versions=self._versions, leaving=self._leaving)

    def tick(self) -> float:
        """Number what waited, send what is due, let callers' deadlines come. Call at 50 Hz.

        Returns:
            When to call again at the latest: no matter when.
        """
        now = self._clock()
        with self._lock:
            if self._sequencer.deposed_by is not None:
                self._depose(now)
            self._sequencer.tick(now)
            if self._sequencer.handover is not None:
                self._hand_over(self._sequencer.handover, now)
            expired = self._expired(now)
            while self._early and self._number(self._early[0]):
                self._early_bytes -= self._early.popleft().size
            self._look_for_trouble()
        self._send()
        for caller in expired:
            self._time_out(caller)
        return NEVER

    def _depose(self, now: float) -> None:
        """A later term is obeyed: this robot's own, of which its file has lost track."""
        above = self._sequencer.deposed_by or 0
        log.warning("term_ended service=%s obeyed=%x", self.spec.name, above)
        self._sequencer = self._begin_term(above)
        self._reach(now)

    def _hand_over(self, begin: Handover, now: float) -> None:
        """Another version takes over: all numbers given are answered, and none waits."""
        log.info("office_changed service=%s version=%s", self.spec.name, begin.version)
        self._sequencer = self._begin_term(begin=begin)
        self._reach(now)

    def _expired(self, now: float) -> list[_Caller]:
        """Take out the callers whose deadline has come. Under the lock."""
        numbered = [i for i, caller in self._numbered.items() if caller.deadline <= now]
        for index in numbered:
            self._sequencer.abandon(index)
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
        sequencer = self._sequencer
        trouble = ""
        if sequencer.held_by:
            trouble = f"robot `{sequencer.held_by}` orders this service"
        elif sequencer.stranded:
            trouble = "no replica that can be reached holds the state; see docs/design/state.md"
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
            sequencer, log_ = self._sequencer, self._sequencer.log
            return {
                **self._outcomes.report(),
                "pending": len(self._numbered) + len(self._early),
                "pending_bytes": self._early_bytes + (log_.held_bytes if log_ else 0),
                "order": {
                    "epoch": sequencer.epoch >> 32,
                    "last": log_.last if log_ else None,
                    "answered": sequencer.mark.index,
                    "joined": len(sequencer.joined),
                    "version": sequencer.office.holder or "",
                    "log": len(log_) if log_ else 0,
                    "checkpoint": log_.checkpoint.index if log_ and log_.checkpoint else None,
                    "trouble": self._trouble,
                },
            }

    def close(self) -> None:
        """Let go of the mark's file. Nothing may be answered afterwards."""
        with self._lock:
            self._numbered.clear()
            self._mark.close()
