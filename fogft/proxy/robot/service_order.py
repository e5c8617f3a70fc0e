"""The order of a stateful service as its dispatcher sees it: by one robot, or by several.

What happens comes in by methods, answers come out of them, and what is to be sent by `take`.
All is called under the dispatcher's lock.

Owns: the interface. Not here: the two that have it (`own_order`, `shared_order`), callers,
deadlines and links (`ordered_dispatcher`). Protocol: docs/design/state.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from fogft.ordering.orders import OrderId
from fogft.ordering.peer import Order
from fogft.ordering.term import OrderedTerm
from fogft.poolfile.state import StateSpec


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


def report_of(term: OrderedTerm | None) -> dict[str, Any]:
    """Return what `report` tells of a term, or of none."""
    log_ = term.log if term else None
    return {
        "epoch": term.epoch >> 32 if term else 0,
        "last": log_.last if log_ else None,
        "joined": len(term.joined) if term else 0,
        "log": len(log_) if log_ else 0,
        "checkpoint": log_.checkpoint.index if log_ and log_.checkpoint else None,
    }
