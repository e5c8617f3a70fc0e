"""A replica as one term of a sequencer knows it, and an order to it. Pure values.

Owns: what is remembered of each replica. Not here: what follows from it (`term`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from fogft.ordering import lag
from fogft.ordering.orders import Op, Promise

RETRY_FIRST_S = 0.02
RETRY_LIMIT_S = 0.5


@dataclass(frozen=True)
class Order:
    """What to send to a replica: an operation of this term, with its bytes."""

    replica: int
    op: Op
    index: int
    payload: bytes = b""


class Phase(Enum):
    """How far a replica has come in this term."""

    UNCLAIMED = "unclaimed"  # it is to be claimed, at once or after a pause
    ASKED = "asked"  # an order is on its way that changes its phase
    CLAIMED = "claimed"  # it obeys, and waits for a state that it can take
    JOINED = "joined"  # it applies what is sent to it


@dataclass
class Peer:
    """A replica as this term knows it."""

    phase: Phase = Phase.UNCLAIMED
    promise: Promise | None = None
    next: int = 0  # the number to send next
    rewind: int | None = None  # go back to it once nothing is on its way
    open: set[int] = field(default_factory=set)
    acked: int = 0
    member: bool = False  # it joined this term, and as far as is known its state is still there
    won: int = 0
    wait_s: float = RETRY_FIRST_S / 2
    retry_at: float = 0.0
    checked_at: float = 0.0
    waits_since: float | None = None
    lag: lag.Lag = field(default_factory=lag.Lag)
    lags: bool = False  # it is sent no more: a snapshot takes it further

    def go_back(self, expected: int) -> None:
        """Send again from a number, once what is on its way has been answered."""
        if self.phase is Phase.JOINED and expected <= self.next:
            self.rewind = expected if self.rewind is None else min(self.rewind, expected)

    def pause(self, now: float) -> None:
        """Claim it anew after a moment, longer each time: that tells where it stands."""
        if self.phase is Phase.UNCLAIMED:
            return
        self.phase = Phase.UNCLAIMED
        self.rewind = None
        self.wait_s = min(self.wait_s * 2, RETRY_LIMIT_S)
        self.retry_at = now + self.wait_s
