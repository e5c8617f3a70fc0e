"""The order of a stateful service that several robots share, as one of them sees it.

Owns: the mark's file, chance, and new terms. Not here: decisions (`fogft.core.shared_robot`),
callers and links (`ordered_dispatcher`). Protocol: docs/design/state.md, "Several robots".
"""

from __future__ import annotations

import logging
import random
import secrets
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from fogft.core.shared_robot import SharedRobot
from fogft.ordering.orders import OrderId
from fogft.ordering.peer import Order
from fogft.poolfile.state import StateSpec
from fogft.proxy.order_mark import MarkFile
from fogft.proxy.robot.service_order import Numbered, report_of

log = logging.getLogger(__name__)


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
        if self._mark.position != self._brain.mark:
            self._mark.write(self._brain.mark)
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
            **report_of(term),
            "answered": self._brain.mark.index,
            "version": term.holder or "" if term else "",
            "sequencer": self._robot if sequences else self._brain.sequencer,
            "members": len(term.members) if term else self._brain.members,
        }
