"""The order of one stateful service on a robot: its terms, one after the other.

What happens comes in by methods, and what is to be sent goes out by `take`. All is called under
the dispatcher's lock.

Owns: terms and the mark's file. Not here: what a term decides (`fogft.ordering.sequencer`),
callers, deadlines and links (`ordered_dispatcher`). Protocol: docs/design/state.md.
"""

from __future__ import annotations

import logging
import secrets
from collections.abc import Iterable, Mapping
from typing import Any

from fogft.link.port import Answer
from fogft.model.refusal import Refusal
from fogft.ordering.orders import OrderId
from fogft.ordering.peer import Order
from fogft.ordering.sequencer import Handover, Sequencer
from fogft.proxy.order_mark import MarkFile

log = logging.getLogger(__name__)


class ServiceOrder:
    """Numbers requests, and says what to send to whom and when an answer counts.

    Args:
        name: The service's.
        mark: What survives this process.
    """

    def __init__(self, name: str, mark: MarkFile) -> None:
        self._name = name
        self._mark = mark
        self._reachable: tuple[Iterable[int], Mapping[int, str], Iterable[int]] = ((), {}, ())
        self._term = self._begin_term()

    def _begin_term(self, above: int = 0, begin: Handover | None = None) -> Sequencer:
        epoch = self._mark.new_term(secrets.randbits(32), above=above)
        mark = self._mark.position
        log.info("term_began service=%s epoch=%x mark=%d", self._name, epoch, mark.index)
        return Sequencer(epoch, mark=mark, holder=self._mark.holder, begin=begin)

    @property
    def ready(self) -> bool:
        """Whether a request taken now can be answered."""
        return self._term.ready

    @property
    def due(self) -> bool:
        """Whether something is to be sent, or decided by `tick`."""
        term = self._term
        ends = term.deposed_by is not None or term.handover is not None
        return term.sends or ends or term.changing

    def submit(self, payload: bytes) -> int | None:
        """Number a request; None while none is taken."""
        return self._term.submit(payload) if self._term.ready else None

    def abandon(self, number: int) -> None:
        """Nobody waits for the answer to this number any more."""
        self._term.abandon(number)

    def reach(
        self,
        replicas: Iterable[int],
        now: float,
        versions: Mapping[int, str],
        leaving: Iterable[int],
    ) -> None:
        """Set which replicas can be sent to."""
        self._reachable = (replicas, versions, leaving)
        self._reach(now)

    def _reach(self, now: float) -> None:
        replicas, versions, leaving = self._reachable
        self._term.reach(replicas, now, versions=versions, leaving=leaving)

    def tick(self, now: float) -> None:
        """Do what is due."""
        if self._term.deposed_by is not None:  # by a term of ours that the file has lost track of
            above = self._term.deposed_by
            log.warning("term_ended service=%s obeyed=%x", self._name, above)
            self._term = self._begin_term(above)
            self._reach(now)
        self._term.tick(now)
        begin = self._term.handover
        if begin is not None:  # all numbers given are answered, and none waits
            log.info("office_changed service=%s version=%s", self._name, begin.version)
            self._term = self._begin_term(begin=begin)
            self._reach(now)

    def take(self) -> list[tuple[int, Order]]:
        """Return the orders to send, each after its term, and forget them."""
        epoch = self._term.epoch
        return [(epoch, order) for order in self._term.take()]

    def is_current(self, id: OrderId) -> bool:
        """Whether an order is of the present term."""
        return id[1] == self._term.epoch

    def replied(self, replica: int, id: OrderId, payload: bytes) -> bool:
        """Take a reply to an order of the present term.

        Returns:
            Whether it is the answer to its number: then that is written down as returned.

        Raises:
            OrderError: The bytes are not what this operation is answered with.
        """
        op, _, index = id
        term = self._term
        answers = term.replied(replica, op, index, payload)
        if answers:
            self._mark.write(term.mark, term.office.holder or "")
        return answers

    def refused(self, replica: int, id: OrderId, answer: Answer, now: float) -> None:
        """Take a refusal, or the loss of an order."""
        if self.is_current(id):
            reason = answer.refusal or Refusal.LOST
            self._term.refused(replica, id[0], id[2], reason, now, detail=answer.detail)

    def declined(self, replica: int, id: OrderId, now: float) -> None:
        """An order was not taken by its link."""
        if self.is_current(id):
            self._term.declined(replica, id[0], id[2], now)

    @property
    def trouble(self) -> str:
        """Why the service cannot be had; empty if nothing is wrong."""
        if self._term.held_by:
            return (
                f"robot `{self._term.held_by}` orders this service, and a service with `state` "
                "is for one robot; for several see docs/state.md"
            )
        if self._term.stranded:
            return "no replica that can be reached holds the state; see docs/design/state.md"
        return ""

    @property
    def held_bytes(self) -> int:
        """Bytes of the requests that are kept."""
        return self._term.log.held_bytes if self._term.log else 0

    def report(self) -> dict[str, Any]:
        """Return the state of the order, as `proxy-status.json` has it."""
        term = self._term
        log_ = term.log
        return {
            "epoch": term.epoch >> 32,
            "last": log_.last if log_ else None,
            "joined": len(term.joined),
            "log": len(log_) if log_ else 0,
            "checkpoint": log_.checkpoint.index if log_ and log_.checkpoint else None,
            "answered": term.mark.index,
            "version": term.office.holder or "",
        }
