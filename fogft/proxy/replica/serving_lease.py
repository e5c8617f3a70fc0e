"""How long a replica keeps serving without hearing from the manager. Pure.

The manager signs a new lease every minute or sooner; each states when it was signed and how long it
lasts. Robots and rendezvous forward leases, and nothing else that they say or do keeps a machine
alive.
"""

from collections.abc import Callable

from fogft.records import roster
from fogft.records.record import Order, Record


class HeldLease:
    """The lease of one replica; before the first one, it never expires.

    It expires no later than if every lease had arrived when it was signed, so holding leases back
    to present them one after another gains nothing. The manager's clock may be set back: a lease
    never counts as signed before the previous one.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._order: Order = (-1, -1)
        self._ahead: float | None = None  # our clock minus the manager's, since the first lease
        self._heard_at = self._ends_at = self._signed_at = 0.0

    def renew(self, record: Record) -> None:
        """Take a verified lease; an older one has no effect."""
        if record.order <= self._order:
            return
        lease, now = roster.lease(record), self._clock()
        ahead = now - lease.at if self._ahead is None else self._ahead
        ahead = max(ahead, self._signed_at - lease.at)
        self._signed_at = min(now, lease.at + ahead)
        ends_at = self._signed_at + lease.lasts_s
        self._order, self._heard_at = record.order, now
        self._ends_at = max(ends_at, self._ends_at)
        self._ahead = ahead  # last: it tells other threads that there is a lease

    @property
    def age_s(self) -> float | None:
        """Seconds since the lease was renewed; None if it never was."""
        return None if self._ahead is None else self._clock() - self._heard_at

    @property
    def left_s(self) -> float | None:
        """Seconds until the lease expires; None without a lease."""
        return None if self._ahead is None else max(0.0, self._ends_at - self._clock())
