"""Choose where the next replica goes. Pure and deterministic.

Spread first, price and distance second: replicas in one zone are preempted together, and a cloud or
a region fails as a whole. Ties are broken by lot, differently for each pool.

Not here: the order within a rank (`listing`), how long a location is avoided (`observed.backoff`).
"""

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

from fogft.model.reason import Cause, Reason
from fogft.model.replica import Offer, Placement
from fogft.planning.listing import Listing, Row, without_offer
from fogft.planning.observed.backoff import EVERYWHERE, Backoff
from fogft.planning.observed.hazard import UNKNOWN, penalty

EPSILON_USD = 1e-9

Rank = tuple[bool, int, int, int]


class Choice(NamedTuple):
    """The chosen offer, or the reason for none."""

    offer: Offer | None
    why_not: Reason | None = None
    # Of the offer: whether its location is avoided, then how many of our other replicas its cloud,
    # region and zone hold.
    rank: Rank = (False, 0, 0, 0)


def crowding(taken: Iterable[Placement]) -> Counter[str]:
    """Count replicas in each failure domain."""
    return Counter(domain for placement in taken for domain in placement.domains)


class Market:
    """The available offers, indexed for many choices.

    Args:
        backing_off: Supplies in backoff, see `Placement.supply`.
        avoid: Locations to use only when no other is left: a replica was lost there lately.
        full: Locations that hold as many replicas as may be lost at once.
        hazards: Location -> losses per hour, as far as known.
    """

    def __init__(
        self,
        listing: Listing,
        *,
        backing_off: Mapping[str, Backoff] | None = None,
        avoid: Collection[str] = (),
        full: Collection[str] = (),
        hazards: Mapping[str, float] | None = None,
    ) -> None:
        pauses = backing_off or {}
        self._avoid = frozenset(avoid)
        self._nothing = listing.trouble
        self.backing_off: Mapping[str, Backoff] = {}  # of all supplies, if all back off
        self.rows = listing.rows
        if hazards:
            self.rows = _weighed(self.rows, hazards)
        if full:
            self.rows = tuple([row for row in self.rows if row.location not in full])
            if not self.rows and not self._nothing:
                self._nothing = Reason(Cause.LOCATION_FULL)
        left_out = listing.supplies.intersection(pauses) if pauses else frozenset()
        if left_out:
            self.rows = tuple([row for row in self.rows if row.supply not in left_out])
        self._clouds = frozenset([row.cloud for row in self.rows])
        if EVERYWHERE in pauses:
            pause = pauses[EVERYWHERE]
            self._nothing = Reason(
                Cause.BACKING_OFF, count=pause.failures, because=(Reason(pause.cause),)
            )
        elif left_out and not self.rows:
            self.backing_off = {place: pauses[place] for place in sorted(left_out)}
            failures = (Reason(pause.cause, location=at) for at, pause in self.backing_off.items())
            self._nothing = Reason(Cause.ALL_BACKING_OFF, because=tuple(failures))

    def choose(
        self,
        taken: Iterable[Placement] | Counter[str],
        *,
        avoid: Collection[str] = (),
        budget_usd_per_hour: float | None = None,
    ) -> Choice:
        """Choose an offer, given the placements of the replicas that stay, or their crowding."""
        if self._nothing:
            return Choice(None, self._nothing)
        count = (taken if isinstance(taken, Counter) else crowding(taken)).get
        avoided = self._avoid.union(avoid)
        limit = math.inf if budget_usd_per_hour is None else budget_usd_per_hour + EPSILON_USD
        ideal = (False, min([count(cloud, 0) for cloud in self._clouds]), 0, 0)
        best: Row | None = None
        best_rank: Rank | None = None
        for row in self.rows:  # sorted by score, so the first of a rank is its best
            if row.usd_per_hour > limit:
                continue
            rank = (
                row.location in avoided,
                count(row.cloud, 0),
                count(row.region, 0),
                count(row.location, 0),
            )
            if best_rank is None or rank < best_rank:
                best, best_rank = row, rank
                if rank == ideal:
                    break
        if best is None or best_rank is None:
            cheapest = min(row.usd_per_hour for row in self.rows)
            left = max(budget_usd_per_hour or 0.0, 0.0)
            dear = Reason(Cause.OVER_BUDGET, usd_per_hour=cheapest, limit_usd_per_hour=left)
            return Choice(None, dear)
        return Choice(best.offer, rank=best_rank)


def _weighed(rows: Sequence[Row], hazards: Mapping[str, float]) -> tuple[Row, ...]:
    """Return rows sorted by score, with the penalty for losses added."""
    unknown = penalty(UNKNOWN)
    known = [
        row._replace(score=row.score + penalty(hazards[row.location]) - unknown)
        for row in rows
        if row.spot and row.location in hazards
    ]
    if not known:
        return tuple(rows)
    rest = [row for row in rows if not row.spot or row.location not in hazards]
    return tuple(sorted([*rest, *known], key=without_offer))
