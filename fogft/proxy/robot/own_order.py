"""The order of a stateful service that this robot has for itself: terms follow each other here.

Owns: terms and the mark's file. Not here: what a term decides (`fogft.ordering.sequencer`), callers
and links (`ordered_dispatcher`). Protocol: docs/design/state.md.
"""

from __future__ import annotations

import logging
import secrets
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from fogft.ordering.orders import OrderId
from fogft.ordering.peer import Order
from fogft.ordering.sequencer import Handover, Sequencer
from fogft.poolfile.state import StateSpec
from fogft.proxy.order_mark import MarkFile
from fogft.proxy.robot.service_order import Numbered, report_of

log = logging.getLogger(__name__)


class OwnOrder:
    """The order of a service that this robot has for itself.

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

    def submit(self, payload: bytes, now: float) -> int | None:
        """Number a request; None while none is taken."""
        return self._term.submit(payload) if self._term.ready else None

    def abandon(self, number: int) -> None:
        """Nobody waits for the answer to this number any more."""
        self._term.abandon(number)

    def adopt(self, state: StateSpec | None) -> None:
        """Follow a changed pool file: nothing in it concerns the order."""

    def reach(
        self,
        replicas: Iterable[int],
        now: float,
        versions: Mapping[int, str],
        leaving: Iterable[int],
        listed: int,
    ) -> None:
        """Set which replicas can be sent to."""
        self._reachable = (replicas, versions, leaving)
        self._reach(now)

    def _reach(self, now: float) -> None:
        replicas, versions, leaving = self._reachable
        self._term.reach(replicas, now, versions=versions, leaving=leaving)

    def tick(self, now: float) -> Sequence[Numbered]:
        """Do what is due; nothing is answered by it."""
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
        return ()

    def take(self) -> list[tuple[int, Order]]:
        """Return the orders to send, each after its term, and forget them."""
        epoch = self._term.epoch
        return [(epoch, order) for order in self._term.take()]

    def replied(
        self, replica: int, id: OrderId, payload: bytes, now: float
    ) -> Sequence[Numbered] | None:
        """Take a reply; return the answer that counts by it, written down as returned."""
        op, epoch, index = id
        term = self._term
        if epoch != term.epoch:
            return None
        if not term.replied(replica, op, index, payload):
            return ()
        self._mark.write(term.mark, term.office.holder or "")
        return (Numbered(index, payload),)

    def refused(self, replica: int, id: OrderId, reason: str, now: float) -> None:
        """Take a refusal, or the loss of an order."""
        op, epoch, index = id
        if epoch == self._term.epoch:
            self._term.refused(replica, op, index, reason, now)

    def declined(self, replica: int, id: OrderId, now: float) -> None:
        """An order was not taken by its link."""
        op, epoch, index = id
        if epoch == self._term.epoch:
            self._term.declined(replica, op, index, now)

    @property
    def trouble(self) -> str:
        """Why the service cannot be had; empty if nothing is wrong."""
        if self._term.held_by:
            return (
                f"robot `{self._term.held_by}` orders this service; several robots can use it "
                "with `shared: true` in its `state`"
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
        return {**report_of(term), "answered": term.mark.index, "version": term.office.holder or ""}
