"""Choose where the next replica goes. Pure and deterministic.

Spread first, price and distance second: replicas in one zone are preempted together, and a
cloud or a region fails as a whole. So the offer whose cloud, then region, then zone holds
the fewest of our replicas wins; among those the one with the lowest score; among those
the cheaper one; among those the first by name.

Owns: the order among offers and the reason when none is left.
Not here: the score (`score`), how long a location rests or is avoided (`quarantine`) and
how many are needed (`planner`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import NamedTuple

from fogft.core.model import Offer, Placement, supply
from fogft.core.quarantine import EVERYWHERE, Backoff
from fogft.core.score import Scale

EPSILON_USD = 1e-9

Rank = tuple[bool, int, int, int]
_WITHOUT_OFFER = itemgetter(slice(0, 7))


@dataclass(frozen=True)
class Choice:
    """An offer, or none and why not, in words.

    Attributes:
        rank: Of the offer: whether its location is avoided, then how many of our other
            replicas its cloud, region and zone hold.
    """

    offer: Offer | None
    why_not: str = ""
    rank: Rank = (False, 0, 0, 0)


class Row(NamedTuple):
    """An offer with what its rank is made of, in the order that decides between equals."""

    score: float
    usd_per_hour: float
    cloud: str
    region: str
    location: str
    instance: str
    spot: bool
    offer: Offer


def domains(placement: Placement) -> tuple[str, str, str]:
    """Return the failure domains that a placement lies in, the widest first."""
    region = f"{placement.cloud}/{placement.region}"
    return placement.cloud, region, placement.location


def crowding(taken: Iterable[Placement]) -> Counter[str]:
    """Count replicas in each failure domain."""
    return Counter(domain for placement in taken for domain in domains(placement))


def is_possible(offer: Offer) -> bool:
    """Whether an offer's price can be true: a finite number, not below zero."""
    return math.isfinite(offer.usd_per_hour) and offer.usd_per_hour >= 0


class Market:
    """Offers, ordered once so that many choices among them are quick.

    Args:
        offers: What can be bought, in any order. Impossible prices are left out.
        excluded: Locations (``cloud``, ``cloud/region`` or all three) that the user ruled out.
        resting: Supplies in backoff, see `Placement.supply`.
        avoid: Locations to use only when no other is left: one was lost there lately.
        scale: How price and distance are weighed.

    Attributes:
        resting: The supplies that it would have, where all that it sells rests; else empty.
    """

    def __init__(
        self,
        offers: Sequence[Offer],
        *,
        excluded: Collection[str] = (),
        resting: Mapping[str, Backoff] | None = None,
        avoid: Collection[str] = (),
        scale: Scale | None = None,
    ) -> None:
        self.scale = scale or Scale()
        self._resting = resting or {}
        self._avoid = frozenset(avoid)
        possible = [o for o in offers if is_possible(o)]
        allowed = possible
        if excluded:
            allowed = [o for o in possible if not any(o.placement.within(p) for p in excluded)]
        rows = sorted(_rows(allowed, self.scale), key=_WITHOUT_OFFER)
        self.rows = [row for row in rows if _supply(row) not in self._resting]
        self.resting = {
            place: self._resting[place]
            for row in rows
            if not self.rows and (place := _supply(row)) in self._resting
        }
        self._clouds = {row.cloud for row in self.rows}
        self._nothing = ""
        if EVERYWHERE in self._resting:
            rest = self._resting[EVERYWHERE]
            self._nothing = f"waiting after {rest.failures} failed launches ({rest.cause})"
        elif not offers:
            self._nothing = "nothing is offered for these resources now"
        elif not possible:
            self._nothing = "every offer has an impossible price"
        elif not allowed:
            self._nothing = "every offered location is excluded"
        elif not self.rows:
            places = sorted({_supply(row) for row in rows})
            causes = ", ".join(f"`{place}`: {self._resting[place].cause}" for place in places)
            self._nothing = f"every location rests after failures ({causes})"

    def choose(
        self,
        taken: Iterable[Placement],
        *,
        avoid: Collection[str] = (),
        budget_usd_per_hour: float | None = None,
    ) -> Choice:
        """Choose an offer, given where our other replicas are.

        Args:
            taken: Where the replicas that stay are.
            avoid: More locations to avoid.
            budget_usd_per_hour: The most that the new machine may cost; None for no limit.
        """
        if self._nothing:
            return Choice(None, self._nothing)
        count = crowding(taken)
        avoided = self._avoid.union(avoid)
        limit = math.inf if budget_usd_per_hour is None else budget_usd_per_hour + EPSILON_USD
        ideal = (False, min(count[cloud] for cloud in self._clouds), 0, 0)
        best: Row | None = None
        best_rank: Rank | None = None
        for row in self.rows:  # by score, so the first of a rank is the best of it
            if row.usd_per_hour > limit:
                continue
            rank = (
                row.location in avoided,
                count[row.cloud],
                count[row.region],
                count[row.location],
            )
            if best_rank is None or rank < best_rank:
                best, best_rank = row, rank
                if rank == ideal:
                    break
        if best is None or best_rank is None:
            cheapest = min(row.usd_per_hour for row in self.rows)
            return Choice(
                None,
                f"the cheapest offer is ${cheapest:.3f}/h and `max_usd_per_hour` "
                f"leaves ${max(budget_usd_per_hour or 0.0, 0.0):.3f}/h",
            )
        return Choice(best.offer, rank=best_rank)


def _supply(row: Row) -> str:
    return row.location if row.spot else supply(row.location, on_demand=True)


def _rows(offers: Iterable[Offer], scale: Scale) -> Iterator[Row]:
    """Yield the rows of offers. There may be thousands: what is equal is worked out once."""
    regions: dict[tuple[str, str], tuple[str, float]] = {}
    for offer in offers:
        place = offer.placement
        key = (place.cloud, place.region)
        if key not in regions:
            regions[key] = domains(place)[1], scale.of_distance(scale.latency(place))
        region, far = regions[key]
        yield Row(
            scale.of_price(offer.usd_per_hour) + far,
            offer.usd_per_hour,
            place.cloud,
            region,
            f"{region}/{place.zone}",
            place.instance,
            place.spot,
            offer,
        )


def choose(
    offers: Sequence[Offer],
    *,
    taken: Collection[Placement],
    excluded: Collection[str] = (),
    resting: Mapping[str, Backoff] | None = None,
    avoid: Collection[str] = (),
    budget_usd_per_hour: float | None = None,
    scale: Scale | None = None,
) -> Choice:
    """Choose among offers once; see `Market`."""
    market = Market(offers, excluded=excluded, resting=resting, avoid=avoid, scale=scale)
    return market.choose(taken, budget_usd_per_hour=budget_usd_per_hour)
