"""A sequencer's view of a replica in one term, and orders to it. Pure values.

Callers proceed at the pace of the fastest replica, so a slower one falls behind. If the faster ones
died, every caller would have to wait until it has caught up. So a replica that is far behind is
restored from a snapshot instead, but not too often. The `sequencer` acts on this view.
"""

from dataclasses import dataclass, field
from enum import Enum

from fogft.ordering.orders import Op, Promise

RETRY_FIRST_S = 0.02
RETRY_LIMIT_S = 0.5
LAG_LIMIT = 256  # requests; further behind, a replica is restored from a snapshot instead
RESTORE_FIRST_S = 2.0
RESTORE_LONGEST_S = 16.0


@dataclass(frozen=True)
class Order:
    """An order to a replica: an operation in this term, with its payload."""

    replica: int
    op: Op
    index: int
    payload: bytes = b""


class Phase(Enum):
    """A replica's phase in this term."""

    UNCLAIMED = "unclaimed"  # to be claimed, at once or after a pause
    ASKED = "asked"  # an order that will change its phase is in flight
    CLAIMED = "claimed"  # it obeys, and waits for a state that it can start from
    JOINED = "joined"  # it applies the requests that it is sent


class Lag:
    """Decides when a replica is too far behind. Snapshots pause the donor, so they become rarer."""

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
    rewind: int | None = None  # resend from this number once no order is in flight
    open: set[int] = field(default_factory=set)
    acked: int = 0
    member: bool = False  # it joined this term, and its state is not known to be lost
    won: int = 0
    wait_s: float = RETRY_FIRST_S / 2
    retry_at: float = 0.0
    went_back: int = 0  # how often since it last acknowledged a number
    checked_at: float = 0.0
    waits_since: float | None = None
    lag: Lag = field(default_factory=Lag)
    lags: bool = False  # it is sent no requests until it is restored from a snapshot

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
