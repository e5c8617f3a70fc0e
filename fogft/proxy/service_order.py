"""The order of a stateful service as its dispatcher sees it: by one robot, or by several.

What happens comes in by methods, answers come out of them, and what is to be sent by `take`.
All is called under the dispatcher's lock.

Owns: terms and the mark's file. Not here: callers, deadlines and links (`ordered_dispatcher`),
decisions (`fogft.core.sequencer`, `fogft.core.shared_robot`). Protocol: docs/design/state.md.
"""

from __future__ import annotations

import logging
import random
import secrets
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from fogft.core.ordered_peer import Order
from fogft.core.ordered_term import OrderedTerm
from fogft.core.ordering import Op
from fogft.core.sequencer import Handover, Sequencer
from fogft.core.shared_robot import SharedRobot
from fogft.core.spec_state import StateSpec
from fogft.proxy.mark import MarkFile

log = logging.getLogger(__name__)

OrderId = tuple[Op, int, int]  # operation, term, index: as `ordering.decode` gives it


class Numbered(NamedTuple):
    """The answer to the request of a number."""

    number: int
    answer: bytes


class ServiceOrder(Protocol):
    """Numbers requests, and says what to send to whom and when an answer counts."""

    @property
    def ready(self) -> bool:
        """Whether a request taken now can be answered."""

    @property
    def due(self) -> bool:
        """Whether something is to be sent, or decided by `tick`."""

    def submit(self, payload: bytes, now: float) -> int | None:
        """Number a request; None while none is taken."""

    def abandon(self, number: int) -> None:
        """Nobody waits for the answer to this number any more."""

    def adopt(self, state: StateSpec | None) -> None:
        """Follow a changed pool file."""

    def reach(
        self,
        replicas: Iterable[int],
        now: float,
        versions: Mapping[int, str],
        leaving: Iterable[int],
        listed: int,
    ) -> None:
        """Set which replicas can be sent to; `listed` is how many the pool has."""

    def tick(self, now: float) -> Sequence[Numbered]:
        """Do what is due; return the answers that count by it."""

    def take(self) -> list[tuple[int, Order]]:
        """Return the orders to send, each after its term, and forget them."""

    def replied(
        self, replica: int, id: OrderId, payload: bytes, now: float
    ) -> Sequence[Numbered] | None:
        """Take a reply; return the answers that count by it, written down as returned.

        None where the order is of a term that has ended.

        Raises:
            OrderError: The bytes are not what this operation is answered with.
        """

    def refused(self, replica: int, id: OrderId, reason: str, now: float) -> None:
        """Take a refusal, or the loss of an order."""

    def declined(self, replica: int, id: OrderId, now: float) -> None:
        """An order was not taken by its link."""

    @property
    def trouble(self) -> str:
        """Why the service cannot be had; empty if nothing is wrong."""

    @property
    def held_bytes(self) -> int:
        """Bytes of the requests that are kept."""

    def report(self) -> dict[str, Any]:
        """Return the state of the order, as `proxy-status.json` has it."""


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
        return {**_report(term), "answered": term.mark.index, "version": term.office.holder or ""}


class SharedOrder:
    """The order of a service that several robots share, as one of them sees it.

    Args:
        name: The service's.
        robot: This robot's name.
        mark: What survives this process.
        founders: How many replicas a service needs to begin.
    """

    def __init__(self, name: str, robot: str, mark: MarkFile, founders: int) -> None:
        self._name = name
        self._robot = robot
        self._mark = mark
        self._brain = SharedRobot(
            secrets.randbits(63) + 1, self._new_epoch, random.random,
            founders=founders, mark=mark.position,
        )  # fmt: skip
        self._written = mark.position

    def _new_epoch(self, above: int) -> int:
        epoch = self._mark.new_term(secrets.randbits(32), above=above)
        log.info("term_claimed service=%s epoch=%x", self._name, epoch)
        return epoch

    @property
    def ready(self) -> bool:
        """Whether a request taken now can be answered, as far as is known."""
        return self._brain.ready

    @property
    def due(self) -> bool:
        """Whether something is to be sent, or decided by `tick`."""
        return self._brain.sends

    def submit(self, payload: bytes, now: float) -> int | None:
        """Number a request; None while too many wait for an answer."""
        return self._brain.submit(payload, now)

    def abandon(self, number: int) -> None:
        """Nobody waits for the answer to this number any more."""
        self._brain.abandon(number)

    def adopt(self, state: StateSpec | None) -> None:
        """Follow a changed pool file: the pool may have more replicas, or fewer."""
        if state is not None:
            self._brain.founders = state.founders

    def reach(
        self,
        replicas: Iterable[int],
        now: float,
        versions: Mapping[int, str],
        leaving: Iterable[int],
        listed: int,
    ) -> None:
        """Set which replicas can be sent to; `listed` is how many the pool has."""
        self._brain.reach(replicas, now, versions=versions, leaving=leaving, listed=listed)

    def tick(self, now: float) -> Sequence[Numbered]:
        """Do what is due; return the answers that count by it."""
        self._brain.tick(now)
        return self._answers()

    def _answers(self) -> Sequence[Numbered]:
        answered = self._brain.take_answers()
        if self._written != self._brain.mark:
            self._mark.write(self._brain.mark)
            self._written = self._brain.mark
        return [Numbered(one.seq, one.answer) for one in answered]

    def take(self) -> list[tuple[int, Order]]:
        """Return the orders to send, each after its term, and forget them."""
        return list(self._brain.take())

    def replied(
        self, replica: int, id: OrderId, payload: bytes, now: float
    ) -> Sequence[Numbered] | None:
        """Take a reply; return the answers that count by it, written down as returned."""
        self._brain.replied(replica, id, payload, now)
        return self._answers()

    def refused(self, replica: int, id: OrderId, reason: str, now: float) -> None:
        """Take a refusal, or the loss of an order."""
        self._brain.refused(replica, id, reason, now)

    def declined(self, replica: int, id: OrderId, now: float) -> None:
        """An order was not taken by its link."""
        self._brain.declined(replica, id, now)

    @property
    def trouble(self) -> str:
        """Why the service cannot be had; empty if nothing is wrong."""
        return self._brain.trouble

    @property
    def held_bytes(self) -> int:
        """Bytes of the requests that are kept."""
        return self._brain.held_bytes

    def report(self) -> dict[str, Any]:
        """Return the state of the order, as `proxy-status.json` has it."""
        term = self._brain.term
        sequences = term is not None and term.base is not None
        return {
            **_report(term),
            "answered": self._brain.mark.index,
            "version": term.holder or "" if term else "",
            "sequencer": self._robot if sequences else self._brain.sequencer,
            "members": len(term.members) if term else self._brain.members,
        }


def _report(term: OrderedTerm | None) -> dict[str, Any]:
    log_ = term.log if term else None
    return {
        "epoch": term.epoch >> 32 if term else 0,
        "last": log_.last if log_ else None,
        "joined": len(term.joined) if term else 0,
        "log": len(log_) if log_ else 0,
        "checkpoint": log_.checkpoint.index if log_ and log_.checkpoint else None,
    }
