"""Prices from a CSV table in the columns of SkyPilot's catalogues. Not here: launching.

``InstanceType, vCPUs, MemoryGiB, AcceleratorName, AcceleratorCount, Region,
AvailabilityZone, Price, SpotPrice``; with ``Cloud``, ``AsOf`` (YYYY-MM-DD) and ``Source``
if a table spans clouds or is dated. Without ``Cloud``, the file's folder names the cloud.
"""

import csv
import datetime
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fogft.cloud.local.catalogue import Instance
from fogft.cloud.local.resources import suffices
from fogft.errors import SpecError
from fogft.model.replica import Offer, Placement
from fogft.poolfile.named_clouds import alternatives, sells
from fogft.poolfile.tree import shown

_NEEDED = ("InstanceType", "Region", "Price", "SpotPrice")


class Row(NamedTuple):
    """An instance type in a place. A price is NaN if it is not sold in that way."""

    place: tuple[str, str, str]  # cloud, region, zone
    instance: Instance
    as_of: float  # when the prices were valid, in seconds since the epoch; 0 if unknown
    source: str  # of the prices


class PriceTable:
    """Offers from a table (`fogft.cloud.port.Seller`)."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._rows = list(_rows(file))
        self._places = {row.place for row in self._rows}

    def offers(self, resources: Mapping[str, Any]) -> Sequence[Offer]:
        """List the cheapest matching machine in each place, cheapest first."""
        best: dict[object, Offer] = {}
        for where, entry in alternatives(resources):
            spot = bool(entry.get("use_spot"))
            named = {place for place in self._places if sells(entry, *place)}
            for row in self._rows:
                price = row.instance.spot_usd_per_hour if spot else row.instance.usd_per_hour
                if math.isnan(price) or row.place not in named:
                    continue
                known = best.get((row.place, spot))
                if (known and price > known.usd_per_hour) or not _suits(where, row, entry):
                    continue
                placement = Placement(*row.place, row.instance.name, spot)
                offer = Offer(placement, price, row.source, row.as_of)
                best[row.place, spot] = min(known or offer, offer, key=_order)
        if not best:
            raise SpecError.of_key(
                "resources",
                f"no row of `{self._file}` matches",
                "relax the resources, or name places in the table",
            )
        return sorted(best.values(), key=_order)


def _order(offer: Offer) -> tuple[float, Placement]:
    return offer.usd_per_hour, offer.placement


def _suits(where: str, row: Row, entry: Mapping[str, Any]) -> bool:
    if entry.get("instance_type") not in (None, row.instance.name):
        return False
    keys = [key for key in ("accelerators", "cpus", "memory") if entry.get(key) is not None]
    return all(suffices(where, key, entry[key], row.instance) for key in keys)


def _rows(file: Path) -> Iterator[Row]:
    try:
        with file.open(newline="", encoding="utf-8") as lines:
            reader = csv.DictReader(line for line in lines if not line.startswith("#"))
            missing = [key for key in _NEEDED if key not in (reader.fieldnames or ())]
            if missing:
                raise SpecError(
                    f"{file}: has no column `{missing[0]}`",
                    "write a table in the columns of SkyPilot's catalogues",
                )
            usual = file.resolve().parent.name
            for number, raw in enumerate(reader, 2):
                yield _row(file, number, raw, usual)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SpecError(f"{file}: cannot be read: {error}") from error


def _row(file: Path, number: int, raw: Mapping[str, str | None], usual: str) -> Row:
    def number_in(key: str, default: float) -> float:
        text = (raw.get(key) or "").strip()
        try:
            value = float(text) if text else default
        except ValueError:
            value = -1.0
        if value < 0 or math.isinf(value):
            what = f"{file}: row {number}: {key}: {shown(text)} is not a number of at least 0"
            raise SpecError(what, "correct the row, or remove it")
        return value

    name = (raw.get("InstanceType") or "").strip()
    devices = (raw.get("AcceleratorName") or "").strip()
    return Row(
        (
            (raw.get("Cloud") or usual).strip().lower(),
            (raw.get("Region") or "").strip().lower(),
            (raw.get("AvailabilityZone") or "").strip().lower(),
        ),
        Instance(
            name,
            int(number_in("vCPUs", 0)),
            int(number_in("MemoryGiB", 0)),
            number_in("Price", math.nan),
            number_in("SpotPrice", math.nan),
            {devices: number_in("AcceleratorCount", 1)} if devices else {},
        ),
        as_of=_moment(file, number, (raw.get("AsOf") or "").strip()),
        source=(raw.get("Source") or "table").strip(),
    )


def _moment(file: Path, number: int, text: str) -> float:
    if not text:
        return 0.0
    try:
        day = datetime.date.fromisoformat(text)
    except ValueError:
        what = f"{file}: row {number}: AsOf: {shown(text)} is not a date"
        raise SpecError(what, "write it as 2024-11-30") from None
    noon = datetime.datetime.combine(day, datetime.time(12), datetime.timezone.utc)
    return noon.timestamp()
