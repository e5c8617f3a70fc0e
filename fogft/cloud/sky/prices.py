"""What can be bought, and for how much: SkyPilot's catalogue, and live spot prices.

The catalogue is a file that SkyPilot renews every few hours; spot prices move meanwhile. So an
offer says where its price comes from and how old it is. Prices are kept for a while: the
planner asks every half minute, and the answer must not cost a second each time.

Not here: the catalogue (`installed`) and the provider's interface (`provider`).
"""

from __future__ import annotations

import json
import logging
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

from fogft.cloud.sky.installed import InstalledSky
from fogft.cloud.sky.provider import NotAllowedError, Provider
from fogft.cloud.sky.sdk import RefusedError
from fogft.errors import CloudUnreachable, SpecError
from fogft.model.replica import Offer

log = logging.getLogger(__name__)

FRESH_S = 300.0
USABLE_S = 3600.0


@dataclass
class Prices:
    """Offers with prices, cached for a while; `submit` runs a function elsewhere."""

    sky: InstalledSky
    providers: Mapping[str, Provider]
    clock: Callable[[], float]
    submit: Callable[[Callable[[], None]], object]

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._kept: dict[str, tuple[float, tuple[Offer, ...]]] = {}
        self._renewing: set[str] = set()

    def offers(self, resources: Mapping[str, Any]) -> Sequence[Offer]:
        """See `fogft.cloud.port.Cloud.offers`. The first call takes seconds, later ones none.

        Prices of `FRESH_S` to `USABLE_S` seconds of age are returned while new ones are fetched.
        """
        key = json.dumps(resources, sort_keys=True, default=str)
        with self._lock:
            at, offers = self._kept.get(key, (-math.inf, ()))
        age_s = self.clock() - at
        if age_s > USABLE_S:
            return self._renewed(key, resources)
        if age_s > FRESH_S:
            self._renew_later(key, resources)
        return offers

    @property
    def regions(self) -> Mapping[str, set[str]]:
        """Cloud -> regions that were offered: where machines of ours can be."""
        with self._lock:
            out: dict[str, set[str]] = {}
            for _, offers in self._kept.values():
                for offer in offers:
                    out.setdefault(offer.placement.cloud, set()).add(offer.placement.region)
            return out

    def _renew_later(self, key: str, resources: Mapping[str, Any]) -> None:
        with self._lock:
            if key in self._renewing:
                return
            self._renewing.add(key)

        def renew() -> None:
            try:
                self._renewed(key, resources)
            except (CloudUnreachable, SpecError) as error:
                log.warning("prices_not_renewed reason=%r", error.message)
            finally:
                with self._lock:
                    self._renewing.discard(key)

        self.submit(renew)

    def _renewed(self, key: str, resources: Mapping[str, Any]) -> tuple[Offer, ...]:
        try:
            listed = self.sky.offers(resources)
        except RefusedError as error:
            what = f"resources: SkyPilot refuses this section: {error.reason.words}"
            raise SpecError(what) from error
        if not listed:
            raise SpecError(
                "resources: no cloud that can be used here sells this",
                "ask for less, or name more clouds and regions; `sky check` lists the clouds "
                "that this account may use",
            )
        offers = tuple(sorted(self._priced(listed), key=lambda o: (o.usd_per_hour, o.placement)))
        with self._lock:
            self._kept[key] = self.clock(), offers
        return offers

    def _priced(self, listed: Sequence[Offer]) -> Sequence[Offer]:
        wanted: dict[tuple[str, str], set[str]] = {}
        for offer in listed:
            place = offer.placement
            if place.spot and place.cloud in self.providers:
                wanted.setdefault((place.cloud, place.region), set()).add(place.instance)
        if not wanted:
            return listed
        with ThreadPoolExecutor(min(8, len(wanted)), "prices") as pool:
            answers = dict(zip(wanted, pool.map(self._live, wanted.items()), strict=True))
        now = self.clock()

        def priced(offer: Offer) -> Offer:
            place = offer.placement
            live = answers.get((place.cloud, place.region), {}) if place.spot else {}
            # Without a zone the cloud chooses one: count with the dearest.
            prices = [
                price
                for (zone, kind), price in live.items()
                if kind == place.instance and place.zone in ("", zone)
            ]
            if not prices:
                return offer
            return replace(offer, usd_per_hour=max(prices), source="live", as_of=now)

        return [priced(offer) for offer in listed]

    def _live(self, wanted: tuple[tuple[str, str], set[str]]) -> Mapping[tuple[str, str], float]:
        (cloud, region), instances = wanted
        try:
            return self.providers[cloud].spot_prices(region, instances)
        except (NotAllowedError, CloudUnreachable) as error:
            log.info("live_prices_missing region=%s/%s reason=%r", cloud, region, str(error))
            return {}
