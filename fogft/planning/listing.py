"""Offers in order of preference, computed once for many plans. Pure.

    score = ln(usd_per_hour) + weight * ln(round trip)

Lower is better. With logarithms, the order of two offers depends on those two alone, and a
hysteresis margin is a percentage. Results for the latest tuple of offers are cached: sorting
thousands takes longer than a whole plan.

Not here: choosing among them (`placement`).
"""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from operator import itemgetter
from typing import NamedTuple
from zlib import crc32

from fogft.model.reason import Cause, Reason
from fogft.model.replica import Offer, Placement, supply

# Lower values count as these.
PRICE_FLOOR_USD = 0.001
LATENCY_FLOOR_S = 0.010
# A region without a measured round trip counts as one on another continent.
UNKNOWN_RTT_S = 0.150


@dataclass(frozen=True)
class Scale:
    """How offers are scored: the weight of round trips, and those that are known."""

    weight: float = 1.0  # of round trips
    # Known round trips by `cloud/region`, in seconds.
    rtt_s: Mapping[str, float] = field(default_factory=dict)
    pool: str = ""  # its name: pools order otherwise equal offers differently

    def latency(self, placement: Placement) -> float | None:
        """Return the round trip to a placement's region in seconds; None if it is not known."""
        return self.rtt_s.get(f"{placement.cloud}/{placement.region}")

    def of_price(self, usd_per_hour: float) -> float:
        """Return a price's part of the score."""
        return math.log(max(usd_per_hour, PRICE_FLOOR_USD))

    def of_distance(self, rtt_s: float | None) -> float:
        """Return a round trip's part of the score."""
        known = UNKNOWN_RTT_S if rtt_s is None else rtt_s
        return self.weight * math.log(max(known, LATENCY_FLOOR_S))


without_offer = itemgetter(slice(0, 8))


class Row(NamedTuple):
    """An offer with its rank; fields are in tie-breaking order."""

    score: float
    usd_per_hour: float
    lot: int  # drawn for the location, so that no name is preferred
    cloud: str
    region: str
    location: str
    instance: str
    spot: bool
    offer: Offer
    supply: str  # see `Placement.supply`


@dataclass(frozen=True)
class Listing:
    """The cheapest offer of each supply, best score first; no other is ever chosen."""

    rows: tuple[Row, ...]
    trouble: Reason | None = None  # why there is no row; None if there is one

    @cached_property
    def supplies(self) -> frozenset[str]:
        """The supplies of all rows."""
        return frozenset(row.supply for row in self.rows)


class Catalogue:
    """An index of one tuple of offers."""

    def __init__(self, offers: Sequence[Offer]) -> None:
        self.offers = offers
        self._listings: dict[object, Listing] = {}

    @cached_property
    def today(self) -> Mapping[tuple[str, Placement], float]:
        """Group and placement -> the lowest price."""
        out: dict[tuple[str, Placement], float] = {}
        for offer in filter(is_possible, self.offers):
            key = offer.group, offer.placement
            out[key] = min(offer.usd_per_hour, out.get(key, math.inf))
        return out

    @cached_property
    def impossible(self) -> str:
        """The location of an offer with an invalid price; empty for none."""
        wrong = (o.placement.location for o in self.offers if not is_possible(o))
        return next(wrong, "")

    def listing(
        self, group: str | None, spot: bool | None, excluded: Collection[str], scale: Scale
    ) -> Listing:
        """Return a group's offers (None: all); only spot or on-demand unless `spot` is None."""
        far = tuple(sorted(scale.rtt_s.items()))
        key = group, spot, frozenset(excluded), scale.weight, far, scale.pool
        if key not in self._listings:
            mine = [
                o
                for o in self.offers
                if (group is None or o.group == group) and spot in (None, o.placement.spot)
            ]
            self._listings[key] = _listing(mine, excluded, scale)
        return self._listings[key]


_latest = Catalogue(())


def catalogue(offers: Sequence[Offer]) -> Catalogue:
    """Return the catalogue of these offers; the last one is cached."""
    global _latest  # noqa: PLW0603 - a memory of one pure result; see the module's header
    if _latest.offers is not offers or not isinstance(offers, tuple):
        _latest = Catalogue(offers)
    return _latest


def is_possible(offer: Offer) -> bool:
    """Whether an offer's price is valid: a finite number, not below zero."""
    return math.isfinite(offer.usd_per_hour) and offer.usd_per_hour >= 0


def _listing(offers: Sequence[Offer], excluded: Collection[str], scale: Scale) -> Listing:
    if not offers:
        return Listing((), Reason(Cause.NOTHING_OFFERED))
    possible = [o for o in offers if is_possible(o)]
    if not possible:
        return Listing((), Reason(Cause.IMPOSSIBLE_PRICE))
    allowed = [o for o in possible if not any(o.placement.within(p) for p in excluded)]
    if not allowed:
        return Listing((), Reason(Cause.ALL_EXCLUDED))
    best: dict[str, Row] = {}
    for row in _rows(allowed, scale):
        known = best.get(row.supply)
        if known is None or without_offer(row) < without_offer(known):
            best[row.supply] = row
    return Listing(tuple(sorted(best.values(), key=without_offer)))


def _rows(offers: Iterable[Offer], scale: Scale) -> Iterator[Row]:
    """Yield the rows of offers. There may be thousands: shared values are computed once."""
    regions: dict[tuple[str, str], tuple[str, float]] = {}
    lots: dict[str, int] = {}
    for offer in offers:
        place = offer.placement
        key = (place.cloud, place.region)
        if key not in regions:
            regions[key] = (
                f"{place.cloud}/{place.region}",
                scale.of_distance(scale.latency(place)),
            )
        region, far = regions[key]
        location = f"{region}/{place.zone}"
        if location not in lots:
            lots[location] = crc32(f"{scale.pool} {location}".encode())
        yield Row(
            scale.of_price(offer.usd_per_hour) + far,
            offer.usd_per_hour,
            lots[location],
            place.cloud,
            region,
            location,
            place.instance,
            place.spot,
            offer,
            location if place.spot else supply(location, on_demand=True),
        )
