"""Offers of SkyPilot's catalogue for a task as launched, and why some clouds cannot run it.

Without accelerators SkyPilot chooses a single machine type, which often has no capacity. So other
types of the cloud's general families are offered, too: as many vCPUs, no less memory.
"""

import importlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from fogft.cloud.sky.sdk import Sale
from fogft.model.replica import Offer, Placement

CHOICES = 5
"""Types of machines that are offered in one location."""

_ZONE_ID = re.compile(r"[a-z]{2,5}\d-[a-z]{2,4}\d")  # `use1-az1`: an id of a zone, not its name
# Types for a steady load on x86: no burstable, bare-metal or old machines.
_FAMILIES = {
    "aws": r"[cmr][5-9][a-z-]*\.\d*x?large",
    "azure": r"Standard_[DEF]\d+[a-z]*_v[2-9]",
    "gcp": r"[cn][2-4]d?-\w+-\d+",
}
_MISSING = {
    "spot_instance": "no spot machines",
    "open_ports": "cannot open ports (not needed with `fogft.dial_in`)",
    "autodown": "machines cannot terminate themselves",
    "docker_image": "cannot run `docker:` images",
    "custom_disk_tier": "no choice of `disk_tier`",
    "image_id": "no custom images",
}


def sale(asked: Iterable[Any], enabled: Sequence[Any]) -> Sale:
    """Return the offers for SkyPilot's `Resources`; those that name no cloud use `enabled`."""
    prices: dict[Placement, float] = {}
    left_out: dict[str, str] = {}
    quotas: dict[tuple[str, bool], tuple[str, float]] = {}
    for one in asked:
        for cloud in enabled if one.cloud is None else [one.cloud]:
            name, wanted = str(cloud).lower(), one.copy(cloud=cloud)
            reason = missing(cloud, wanted)
            left_out.setdefault(name, reason or "nothing there matches")
            for machine in [] if reason else _machines(cloud, wanted):
                for place, price in _sold(name, machine):
                    prices[place] = min(prices.get(place, price), price)
                    key = place.instance, place.spot
                    if name == "aws" and key not in quotas:
                        codes = importlib.import_module("sky.catalog.aws_catalog")
                        has = cloud.get_vcpus_mem_from_instance_type(machine.instance_type)
                        quotas[key] = str(codes.get_quota_code(*key) or ""), float(has[0] or 0.0)
    fetched = {cloud: _fetched_at(cloud) for cloud in {place.cloud for place in prices}}
    offers = [Offer(p, price, "catalogue", fetched[p.cloud]) for p, price in prices.items()]
    offers.sort(key=lambda o: (o.usd_per_hour, o.placement))
    left_out = {name: why for name, why in left_out.items() if name not in fetched}
    return Sale(offers, left_out, {key: quota for key, quota in quotas.items() if quota[0]})


def missing(cloud: Any, resources: Any) -> str:
    """Return what a cloud lacks for a launch, or refuses of it; empty if nothing."""
    features = importlib.import_module("sky.clouds").CloudImplementationFeatures
    no = importlib.import_module("sky.exceptions").NotSupportedError
    lacking = []
    needed = {*resources.get_required_cloud_features(), features.AUTODOWN}
    for feature in sorted(needed, key=lambda one: str(one.value)):
        try:
            cloud.check_features_are_supported(resources, {feature})
        except no:
            lacking.append(_MISSING.get(feature.value, f"no `{feature.value}`"))
    for label, value in (resources.labels or {}).items():
        accepted, why = cloud.is_label_valid(label, value)
        if not accepted:
            lacking.append(f"refuses the label `{label}: {value}` ({why})")
    return "; ".join(lacking)


def _machines(cloud: Any, resources: Any) -> list[Any]:
    """Return the launchable machines that match, SkyPilot's own choice first."""
    chosen = list(cloud.get_feasible_launchable_resources(resources, num_nodes=1).resources_list)
    if len(chosen) != 1 or resources.instance_type or resources.accelerators:
        return chosen
    exact = not str(resources.memory or "+").endswith(("+", "x"))
    kinds = _like(str(cloud).lower(), chosen[0].instance_type, exact=exact)
    return [*chosen, *(chosen[0].copy(instance_type=kind) for kind in kinds)]


def _like(cloud: str, instance: str, *, exact: bool) -> list[str]:
    """Return other types with as many vCPUs and no less (`exact`: equal) memory, cheapest first."""
    family = _FAMILIES.get(cloud)
    if family is None:
        return []
    common = importlib.import_module("sky.catalog.common")
    rows = common.read_catalog(f"{cloud}/vms.csv")
    mine = rows[rows["InstanceType"] == instance]
    if mine.empty:
        return []
    first = mine.iloc[0]
    same = rows["vCPUs"] == first["vCPUs"]
    same &= rows["AcceleratorName"].isna() & rows["InstanceType"].str.fullmatch(family)
    memory = rows["MemoryGiB"]
    same &= memory == first["MemoryGiB"] if exact else memory >= first["MemoryGiB"]
    if "Arch" in rows.columns:
        same &= rows["Arch"] == first["Arch"]
    least = rows[same].groupby("InstanceType")["Price"].min().sort_values()
    return [str(kind) for kind in least.index if kind != instance][: 2 * CHOICES]


def _sold(cloud: str, machine: Any) -> Iterator[tuple[Placement, float]]:
    instance = machine.instance_type
    if machine.accelerators and cloud == "gcp":
        name, count = next(iter(machine.accelerators.items()))
        instance = f"{instance}+{name}:{count}"  # on GCP the type does not imply them
    price = _price(cloud, machine)
    for region in machine.get_valid_regions_for_launchable():
        for zone in [zone.name for zone in region.zones or ()] or [None]:
            named = None if zone is None or _ZONE_ID.fullmatch(zone) else zone
            place = Placement(cloud, region.name, named or "", instance, machine.use_spot)
            yield place, float(price(region.name, zone))


def _price(cloud: str, machine: Any) -> Callable[[str, str | None], float]:
    """Return a function of region and zone for the price; SkyPilot searches its whole catalogue."""
    try:
        of_cloud = importlib.import_module(f"sky.catalog.{cloud}_catalog")
        common = importlib.import_module("sky.catalog.common")
        rows = of_cloud._get_df() if cloud == "aws" else of_cloud._df
        search = common.get_hourly_cost_impl
    except (ImportError, AttributeError):  # another version of SkyPilot
        rows = None
    if rows is None or cloud not in _FAMILIES or machine.accelerators:  # accelerators cost extra
        return lambda region, zone: machine.copy(region=region, zone=zone).get_cost(3600)
    own = rows[rows["InstanceType"] == machine.instance_type]
    return lambda *place: search(own, machine.instance_type, machine.use_spot, *place)


def _fetched_at(cloud: str) -> float:
    """Return when SkyPilot last fetched a cloud's catalogue: seconds since the epoch, 0 unknown."""
    try:
        common = importlib.import_module("sky.catalog.common")
        return Path(common.get_catalog_path(f"{cloud}/vms.csv")).stat().st_mtime
    except (ImportError, AttributeError, OSError):
        return 0.0


def best(offers: Sequence[Offer]) -> tuple[list[Offer], Mapping[Placement, Sequence[Offer]]]:
    """Return the cheapest offer of each `Placement.supply`, and its alternatives by placement.

    At most `CHOICES` per supply in total, none at more than twice the cheapest one's price.
    """
    by_supply: dict[str, list[Offer]] = {}
    for offer in sorted(offers, key=lambda o: (o.usd_per_hour, o.placement)):
        by_supply.setdefault(offer.placement.supply, []).append(offer)
    instead = {
        first.placement: [o for o in rest if o.usd_per_hour <= 2 * first.usd_per_hour]
        for first, *rest in (found[:CHOICES] for found in by_supply.values())
    }
    return [found[0] for found in by_supply.values()], instead
