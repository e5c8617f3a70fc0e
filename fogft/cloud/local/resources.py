"""Match the local cloud's offers to a task's `resources`, written for any cloud. Pure."""

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from fogft.cloud.local.catalogue import CLOUD, Catalogue, Instance, Zone
from fogft.errors import SpecError
from fogft.model.names import VM_CLOUDS
from fogft.model.replica import Offer, Placement
from fogft.poolfile.named_clouds import alternatives, place
from fogft.poolfile.tree import nearest, shown

CLOUDS = (CLOUD, "*", *VM_CLOUDS)
_AMOUNT = re.compile(r"(\d+(?:\.\d+)?)(\+?)")
_GB = re.compile(r"(?<=\d)\s*g[bi]", re.IGNORECASE)  # SkyPilot's unit of `memory`
_PER_CPU = re.compile(r"(\d+(?:\.\d+)?)x")
_ACCELERATOR = re.compile(r"([A-Za-z][\w.-]*)(?::(\d+(?:\.\d+)?))?")


def offers_for(catalogue: Catalogue, resources: Mapping[str, Any]) -> list[Offer]:
    """Return the cheapest matching instance in each zone. Raises `SpecError`: there is none."""
    best: dict[Placement, Offer] = {}
    for where, entry in alternatives(resources):
        spot = bool(entry.get("use_spot"))
        instance = _instance(catalogue, where, entry, spot)
        for zone in _zones(catalogue, where, entry):
            price = instance.spot_usd_per_hour if spot else instance.usd_per_hour
            placement = Placement(CLOUD, zone.region, zone.name, instance.name, spot)
            best[placement] = Offer(placement, round(price * zone.price_factor, 4))
    return sorted(best.values(), key=lambda offer: (offer.usd_per_hour, offer.placement))


def _zones(catalogue: Catalogue, where: str, entry: Mapping[str, Any]) -> list[Zone]:
    infra = entry.get("infra")
    if infra is not None:
        parts = [part.strip() for part in str(infra).split("/")]
        if len(parts) > 3 or not all(parts):
            what = f"{shown(infra)} is not `cloud/region/zone`"
            raise SpecError.of_key(
                f"{where}.infra", what, "write a place such as `local/us-west-1`"
            )

    def wrong(key: str, what: str, name: str, known: Iterable[str]) -> SpecError:
        key = key if infra is None else "infra"
        return SpecError.of_key(f"{where}.{key}", f"{what} {shown(name)}", nearest(name, known))

    cloud, region, name = place(entry)
    if cloud not in ("", *CLOUDS):
        raise wrong("cloud", "there is no cloud", cloud, CLOUDS)
    regions = {zone.region for zone in catalogue.zones}
    if region and region not in regions:
        raise wrong("region", "the local cloud has no region", region, regions)
    there = [zone for zone in catalogue.zones if region in ("", zone.region)]
    # Other clouds' zone names begin with the region: us-west-1a, us-west1-a.
    found = [z for z in there if name in ("", z.name, z.region + z.name, f"{z.region}-{z.name}")]
    if not found:
        here = f"region `{region}`" if region else "the local cloud"
        raise wrong("zone", f"{here} has no zone", name, {zone.name for zone in there})
    return found


def _instance(catalogue: Catalogue, where: str, entry: Mapping[str, Any], spot: bool) -> Instance:
    """Return the cheapest matching instance."""
    named = entry.get("instance_type")
    names = [instance.name for instance in catalogue.instances]
    if named is not None and named not in names:
        what = f"the local cloud has no {shown(named)}"
        hint = f"{nearest(str(named), names)}; or ask for `cpus: 4+` instead"
        raise SpecError.of_key(f"{where}.instance_type", what, hint)
    fitting = [i for i in catalogue.instances if named in (None, i.name)]
    for key in ("accelerators", "cpus", "memory"):
        if entry.get(key) is None:
            continue
        kept = [i for i in fitting if suffices(where, key, entry[key], i)]
        if not kept:
            have = ", ".join(f"`{_amount_of(i, key)}`" for i in fitting)
            raise SpecError.of_key(
                f"{where}.{key}",
                f"the local cloud has no machine with {shown(entry[key])}",
                f"there are: {have}; `regions.yaml` can add others" if have else "",
            )
        fitting = kept
    return min(fitting, key=lambda i: (i.spot_usd_per_hour if spot else i.usd_per_hour, i.name))


def suffices(where: str, key: str, wanted: Any, instance: Instance) -> bool:
    """Return whether a machine satisfies a key. Raises `SpecError`: `wanted` is not an amount."""
    if key == "accelerators":
        return any(
            instance.accelerators.get(name, 0) >= count for name, count in _devices(where, wanted)
        )
    has = instance.cpus if key == "cpus" else instance.memory_gb
    text = str(wanted).strip()
    if key == "memory":
        text = _GB.sub("", text)
    per_cpu = _PER_CPU.fullmatch(text) if key == "memory" else None
    if per_cpu:
        return has >= float(per_cpu[1]) * instance.cpus
    match = _AMOUNT.fullmatch(text)
    if isinstance(wanted, bool) or match is None or float(match[1]) <= 0:
        what = f"{shown(wanted)} is not an amount"
        raise SpecError.of_key(
            f"{where}.{key}", what, f"write `{key}: 8`, or `{key}: 8+` for at least 8"
        )
    return has >= float(match[1]) if match[2] else has == float(match[1])


def _devices(where: str, wanted: Any) -> Iterator[tuple[str, float]]:
    """Yield the alternatives of `accelerators`: ``L4``, ``L4:2``, ``{L4: 2}``, ``[L4, T4]``."""
    if isinstance(wanted, Mapping):
        items = [name if n is None else f"{name}:{n}" for name, n in wanted.items()]
    else:
        items = wanted if isinstance(wanted, list) else [wanted]
    for item in items:
        match = _ACCELERATOR.fullmatch(str(item).strip())
        if match is None:
            what = f"{shown(item)} is not an accelerator"
            raise SpecError.of_key(f"{where}.accelerators", what, "write `accelerators: L4:1`")
        yield match[1], float(match[2] or 1)


def _amount_of(instance: Instance, key: str) -> str:
    if key == "accelerators":
        names = "+".join(f"{n}:{c:g}" for n, c in instance.accelerators.items())
        return f"{instance.name} ({names or 'none'})"
    amount = instance.cpus if key == "cpus" else instance.memory_gb
    return f"{instance.name} ({amount:g})"
