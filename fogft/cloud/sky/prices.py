"""Offers and their prices: SkyPilot's catalogue, live spot prices, disks, quotas.

SkyPilot updates its catalogue every few hours; spot prices change in between.
"""

import json
import logging
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

from fogft.cloud.sky.catalogue import best
from fogft.cloud.sky.installed import InstalledSky
from fogft.cloud.sky.kept import Kept
from fogft.cloud.sky.provider import NotAllowedError, Provider
from fogft.cloud.sky.sdk import RefusedError, Sale
from fogft.cloud.sky.task import DISK_GB, alternative, as_launched
from fogft.errors import CloudUnreachable, SpecError
from fogft.model.replica import Offer, Placement

log = logging.getLogger(__name__)

K = TypeVar("K")
V = TypeVar("V")
FRESH_S = 300.0
USABLE_S = 3600.0
# List prices of 2024-11 in each cloud's cheapest regions, for SkyPilot's disk without a
# `disk_tier`. Other clouds' prices are unknown; many include disk and address in the machine.
HOURS_A_MONTH = 730.0
# gp3 on AWS, a balanced disk on GCP; Azure prices Premium SSDs in steps: this is the usual one.
DISK_USD_PER_GB_MONTH = {"aws": 0.08, "azure": 0.15, "gcp": 0.10}
ADDRESS_USD_PER_HOUR = {"aws": 0.005, "azure": 0.005, "gcp": 0.005}
SPOT_ADDRESS_USD_PER_HOUR = {"gcp": 0.0025}
_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([kmgtp]?)i?b?\+?", re.IGNORECASE)
_GB = {"k": 2**-20, "m": 2**-10, "": 1.0, "g": 1.0, "t": 2**10, "p": 2**20}


class _Sold(NamedTuple):
    offers: tuple[Offer, ...]  # the cheapest of each `Placement.supply`
    instead: Mapping[Placement, Sequence[Offer]]  # the alternatives to each offer
    left_out: Collection[str]  # in sentences


@dataclass
class Prices:
    """Offers with prices, cached for a while; `submit` runs a function in the background."""

    sky: InstalledSky
    providers: Mapping[str, Provider]
    clock: Callable[[], float]
    submit: Callable[[Callable[[], None]], object]

    def __post_init__(self) -> None:
        self._kept: dict[str, Kept[_Sold]] = {}  # by the `resources` asked for
        self._asked: dict[str, float] = {}  # when last asked, by the same key
        self._quotas: dict[tuple[str, str], tuple[float, float | None]] = {}
        self._unread: dict[str, str] = {}  # cloud -> why its quotas cannot be read

    def offers(self, resources: Mapping[str, Any]) -> Sequence[Offer]:
        """See `fogft.cloud.port.Cloud.offers`. The first call takes seconds, later ones rarely."""
        key = json.dumps(resources, sort_keys=True, default=str)
        if key not in self._kept:
            self._kept[key] = Kept(
                partial(self._ask, resources),
                *(FRESH_S, USABLE_S, self.clock, self.submit),
                failed=lambda error: log.warning("prices_not_renewed reason=%r", error.message),
            )
        self._asked[key] = self.clock()
        return self._kept[key].get().offers

    def instead(self, placement: Placement, limit: float | None) -> Sequence[Offer]:
        """Return alternatives to a placement for at most `limit` USD per hour, cheapest first."""
        lately = self.clock() - USABLE_S
        keys = [key for key, at in list(self._asked.items()) if at >= lately]  # threads may add
        used = [self._kept[key].answer for key in keys]
        asked = [sold.instead[placement] for sold in used if sold and placement in sold.instead]
        allowed = [{offer.placement for offer in others} for others in asked]  # for each request
        found = [o for o in asked[0] if all(o.placement in a for a in allowed)] if asked else []
        return [offer for offer in found if limit is None or offer.usd_per_hour <= limit]

    def left_out(self) -> Sequence[str]:
        """Return, in sentences, what is not offered because it could not be launched."""
        return sorted({said for sold in self._answers() for said in sold.left_out})

    @property
    def regions(self) -> Mapping[str, set[str]]:
        """Cloud -> regions that were offered, where our machines may be."""
        out: dict[str, set[str]] = {}
        for place in (offer.placement for sold in self._answers() for offer in sold.offers):
            out.setdefault(place.cloud, set()).add(place.region)
        return out

    def _answers(self) -> list[_Sold]:
        return [kept.answer for kept in list(self._kept.values()) if kept.answer is not None]

    def _ask(self, resources: Mapping[str, Any]) -> _Sold:
        try:
            sale = self.sky.offers(as_launched(resources))
        except RefusedError as error:
            what = f"SkyPilot rejects this section: {error.reason.words}"
            raise SpecError.of_key("resources", what) from error
        left_out = [f"`{name}` is left out: {why}" for name, why in sale.left_out.items()]
        within = self._within_quotas(sale, left_out)
        if not within:
            told = f" ({'; '.join(left_out)})" if left_out else ""
            raise SpecError.of_key(
                "resources",
                f"no cloud you can use offers this{told}",
                "relax the resources or name more clouds and regions; `sky check` lists the clouds "
                "you can use",
            )
        firsts, instead = best([_with_extras(o, resources) for o in self._priced(within)])
        return _Sold(tuple(firsts), instead, left_out)

    def _within_quotas(self, sale: Sale, left_out: list[str]) -> Sequence[Offer]:
        """Return the offers that fit the account's quotas, assuming that nothing else runs."""
        needed: dict[Placement, tuple[tuple[str, str, str], float]] = {}  # which quota, how much
        for place in (offer.placement for offer in sale.offers):
            code, vcpus = sale.quotas.get((place.instance, place.spot), ("", 0.0))
            if code and place.cloud in self.providers:
                needed[place] = (place.cloud, place.region, code), vcpus
        if not needed:
            return sale.offers
        limits = _side_by_side({quota for quota, _ in needed.values()}, self._quota)
        left_out += self._unread.values()
        kept = []
        for offer in sale.offers:
            (cloud, region, code), vcpus = needed.get(offer.placement, (("", "", ""), 0.0))
            limit = limits.get((cloud, region, code))
            if limit is None or limit >= vcpus:
                kept.append(offer)
                continue
            kind = "spot" if offer.placement.spot else "on demand"
            said = (
                f"`{offer.placement.instance}` {kind} in `{cloud}/{region}` is left out: the quota "
                f"{code} allows {limit:g} vCPUs, but it needs {vcpus:g}; request an increase"
            )
            if said not in left_out:  # once for all its zones
                left_out.append(said)
        return kept

    def _quota(self, wanted: tuple[str, str, str]) -> float | None:
        cloud, region, code = wanted
        key = f"{cloud}/{region}", code
        at, value = self._quotas.get(key, (-math.inf, None))
        if not 0 <= self.clock() - at <= USABLE_S:
            self._unread.pop(cloud, None)
            try:
                value = self.providers[cloud].quota(region, code)
            except CloudUnreachable as error:
                log.info("quota_unknown region=%s reason=%r", key[0], str(error))
                value = None
            except NotAllowedError as error:
                said = f"the quotas of `{cloud}` cannot be read, so offers above them are shown"
                self._unread[cloud], value = f"{said}: {error}", None
            self._quotas[key] = self.clock(), value
        return value

    def _priced(self, listed: Sequence[Offer]) -> Sequence[Offer]:
        wanted: dict[tuple[str, str], set[str]] = {}
        for offer in listed:
            place = offer.placement
            if place.spot and place.cloud in self.providers:
                wanted.setdefault((place.cloud, place.region), set()).add(place.instance)
        if not wanted:
            return listed

        def live(where: tuple[str, str]) -> Mapping[tuple[str, str], float]:
            cloud, region = where
            provider, kinds = self.providers[cloud], wanted[where]
            try:
                return provider.spot_prices(region, kinds)
            except (NotAllowedError, CloudUnreachable) as error:
                log.info("prices_unknown region=%s reason=%r", "/".join(where), str(error))
                return {}

        answers = _side_by_side(wanted, live)
        now = self.clock()

        def priced(offer: Offer) -> Offer:
            place = offer.placement
            found = answers.get((place.cloud, place.region), {}) if place.spot else {}
            # Without a zone the cloud chooses one: assume the most expensive.
            prices = [
                price
                for (zone, kind), price in found.items()
                if kind == place.instance and place.zone in ("", zone)
            ]
            if not prices:
                return offer
            return replace(offer, usd_per_hour=max(prices), source="live", as_of=now)

        return [priced(offer) for offer in listed]


def _side_by_side(wanted: Collection[K], ask: Callable[[K], V]) -> dict[K, V]:
    with ThreadPoolExecutor(min(8, len(wanted)), "prices") as pool:
        return dict(zip(wanted, pool.map(ask, wanted), strict=True))


def _with_extras(offer: Offer, resources: Mapping[str, Any]) -> Offer:
    more = extras_usd_per_hour(offer.placement, resources)
    return replace(offer, usd_per_hour=offer.usd_per_hour + more, extras_usd_per_hour=more)


def extras_usd_per_hour(placement: Placement, resources: Mapping[str, Any]) -> float:
    """Return what a machine's address and disk cost, in US dollars per hour."""
    address = ADDRESS_USD_PER_HOUR.get(placement.cloud, 0.0)
    if placement.spot:
        address = SPOT_ADDRESS_USD_PER_HOUR.get(placement.cloud, address)
    return address + disk_usd_per_hour(placement, resources)


def disk_usd_per_hour(placement: Placement, resources: Mapping[str, Any]) -> float:
    """Return what a machine's disk costs, in US dollars per hour."""
    size_gb = disk_gb(alternative(resources, placement).get("disk_size") or DISK_GB)
    return size_gb * DISK_USD_PER_GB_MONTH.get(placement.cloud, 0.0) / HOURS_A_MONTH


def disk_gb(asked: Any) -> float:
    """Parse a `disk_size` as SkyPilot does, in GB; 0 if it is not a size."""
    match = _SIZE.fullmatch(str(asked).strip())
    return float(match[1]) * _GB[match[2].lower()] if match else 0.0
