"""A sequencer's view of a replica in one term, and orders to it. Pure values.

Callers go as fast as the fastest replica, so a slower one falls behind. Should the faster ones die,
every caller would wait until it has applied all that it lacks. So one that is far behind is given a
snapshot instead, though not too often. What follows from all this is the `sequencer`'s.
"""

from dataclasses import dataclass, field
from enum import Enum

from fogft.ordering.orders import Op, Promise

RETRY_FIRST_S = 0.02
RETRY_LIMIT_S = 0.5
LAG_LIMIT = 256  # further behind, a replica is given a snapshot rather than every request since
RESTORE_FIRST_S = 2.0
RESTORE_LONGEST_S = 16.0


@dataclass(frozen=True)
class Order:
    """An order to a replica: an operation of this term, with its bytes."""

    replica: int
    op: Op
    index: int
    payload: bytes = b""


class Phase(Enum):
    """A replica's phase in this term."""

    UNCLAIMED = "unclaimed"  # it is to be claimed, at once or after a pause
    ASKED = "asked"  # an order is on its way that changes its phase
    CLAIMED = "claimed"  # it obeys, and waits for a state that it can take
    JOINED = "joined"  # it applies what is sent to it


class Lag:
    """How far a replica is behind. Snapshots pause the sender, so they become rarer."""

    def __init__(self) -> None:
        self._wait_s = RESTORE_FIRST_S
        self._next_at = 0.0

    def too_far(self, behind: int, now: float) -> bool:
        """Whether a replica with this many unanswered requests should be restored now."""
        if behind <= LAG_LIMIT:
            if now >= self._next_at + self._wait_s:
                self._wait_s = RESTORE_FIRST_S  # it has kept up for as long again
            return False
        if now < self._next_at:
            return False
        self._next_at = now + self._wait_s
        self._wait_s = min(2 * self._wait_s, RESTORE_LONGEST_S)
        return True


@dataclass
class Peer:
    """A sequencer's view of a replica in this term."""

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
    went_back: int = 0  # so often since it last acknowledged a number
    checked_at: float = 0.0
    waits_since: float | None = None
    lag: Lag = field(default_factory=Lag)
    lags: bool = False  # it is sent no more: a snapshot takes it further

    @property
    def joined(self) -> bool:
        """Whether it applies requests."""
        return self.phase is Phase.JOINED

    def join(self, expected: int) -> None:
        """Note that it has joined and expects this number next."""
        self.phase, self.member = Phase.JOINED, True
        self.wait_s, self.rewind = RETRY_FIRST_S / 2, None
        self.next, self.acked = expected, expected - 1

    def go_back(self, expected: int) -> None:
        """Resend from a number, once orders in flight have been answered."""
        if self.joined and expected <= self.next:
            self.rewind = expected if self.rewind is None else min(self.rewind, expected)

    def pause(self, now: float) -> None:
        """Claim it again after a pause, longer each time, to learn its position."""
        if self.phase is Phase.UNCLAIMED:
            return
        self.phase = Phase.UNCLAIMED
        self.rewind = None
        self.wait_s = min(self.wait_s * 2, RETRY_LIMIT_S)
        self.retry_at = now + self.wait_s
