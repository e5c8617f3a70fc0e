"""The local cloud's catalogue: regions, zones, instance types and prices.

Prices are made up. ``regions.yaml`` in the cloud's folder overrides any part of it.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from fogft.errors import SpecError
from fogft.poolfile.tree import Section, plain, shown

CLOUD = "local"


@dataclass(frozen=True)
class Zone:
    """A zone of the local cloud, with its capacity and price factor."""

    region: str
    name: str
    boot_s: float = 0.5  # from the order until the machine runs
    notice_s: float = 5.0  # between a preemption notice and the end
    capacity: int = 8  # maximum number of machines
    price_factor: float = 1.0  # multiplies all prices here
    relay: bool = True  # in front of machines, to slow and cut links

    @property
    def location(self) -> str:
        """``local/region/zone``."""
        return f"{CLOUD}/{self.region}/{self.name}"


@dataclass(frozen=True)
class Instance:
    """An instance type. Prices in US dollars per hour, before a zone's factor."""

    name: str
    cpus: int
    memory_gb: int
    usd_per_hour: float
    spot_usd_per_hour: float
    accelerators: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Catalogue:
    """All zones and instance types."""

    zones: tuple[Zone, ...]
    instances: tuple[Instance, ...]


# Region -> its price factor and boot time in seconds.
REGIONS = {
    "us-west-2": (1.00, 0.4),
    "us-east-1": (1.03, 0.5),
    "us-west-1": (1.17, 0.5),
    "eu-central-1": (1.20, 0.6),
    "ap-northeast-1": (1.29, 0.8),
}

BUILT_IN = Catalogue(
    zones=tuple(
        Zone(region, zone, boot_s=boot_s, price_factor=round(factor * more, 3))
        for region, (factor, boot_s) in REGIONS.items()
        for zone, more in (("a", 1.0), ("b", 1.04))
    ),
    instances=(
        Instance("cpu4", 4, 16, 0.192, 0.066),
        Instance("cpu8", 8, 32, 0.384, 0.131),
        Instance("cpu16", 16, 64, 0.768, 0.259),
        Instance("cpu32", 32, 128, 1.536, 0.515),
    ),
)


FILE = "regions.yaml"
ZONE_KEYS = ("boot_s", "notice_s", "capacity", "price_factor", "relay")
INSTANCE_KEYS = ("cpus", "memory_gb", "usd_per_hour", "spot_usd_per_hour", "accelerators")
_NAME = re.compile(r"[a-z0-9]([a-z0-9-]{0,38}[a-z0-9])?")


def read(path: Path) -> Catalogue:
    """Return the catalogue in a file, or the built-in one if there is no file."""
    try:
        text = path.read_text()
    except FileNotFoundError:
        return BUILT_IN
    except (OSError, UnicodeDecodeError) as error:
        raise SpecError(f"{path}: cannot be read: {error}") from error
    if not re.sub(r"#.*", "", text).strip():
        return BUILT_IN
    from fogft.poolfile.yaml_tree import tree  # late: it loads PyYAML

    top = Section(str(path), "", tree(text, str(path)), "write `regions:` with regions below it")
    top.only((*ZONE_KEYS, "instances", "regions"))
    zones, instances = BUILT_IN.zones, BUILT_IN.instances
    if top.has("instances"):
        instances = tuple(_instances(top.section("instances")))
    if top.has("regions"):
        zones = tuple(_regions(top.section("regions"), _zone(top, Zone("", ""))))
    else:
        zones = tuple(_zone(top, zone) for zone in zones)
    if not zones or not instances:
        key = "regions" if instances else "instances"
        raise top.error(key, "is empty", "add one, or remove the key")
    return Catalogue(zones, instances)


def _regions(section: Section, default: Zone) -> Iterator[Zone]:
    for name in section.children:
        _named(section, name, name, "a region")
        region = section.section(name, "write `{zones: [a, b]}`")
        region.only((*ZONE_KEYS, "zones"))
        here = replace(_zone(region, default), region=name)
        zones = region.children.get("zones")
        if zones is None or isinstance(zones.value, tuple):
            for zone in plain(zones) if zones else ["a"]:
                yield replace(here, name=_named(region, "zones", zone, "a zone"))
        else:
            below = region.section("zones", "write `[a, b]` or `{a: {capacity: 2}}`")
            for zone in below.children:
                settings = below.section(zone, "write `{capacity: 2}` or `{}`")
                settings.only(ZONE_KEYS)
                yield replace(_zone(settings, here), name=_named(region, "zones", zone, "a zone"))


def _zone(section: Section, default: Zone) -> Zone:
    return replace(
        default,
        boot_s=section.number("boot_s", 86_400, "seconds", default.boot_s),
        notice_s=section.number("notice_s", 86_400, "seconds", default.notice_s),
        capacity=section.whole("capacity", default.capacity, 0, 10_000),
        price_factor=section.number("price_factor", 1000, "times", default.price_factor),
        relay=section.flag("relay", default.relay),
    )


def _instances(section: Section) -> Iterator[Instance]:
    for name in section.children:
        _named(section, name, name, "an instance")
        entry = section.section(name, "write `{cpus: 4, memory_gb: 16, usd_per_hour: 0.2}`")
        entry.only(INSTANCE_KEYS)
        usd_per_hour = entry.number("usd_per_hour", 10_000, "US dollars per hour", 0.05)
        wanted = entry.section("accelerators", "write `{L4: 1}`")
        yield Instance(
            name=name,
            cpus=entry.whole("cpus", 4, 1, 4096),
            memory_gb=entry.whole("memory_gb", 16, 1, 65_536),
            usd_per_hour=usd_per_hour,
            spot_usd_per_hour=entry.number(
                "spot_usd_per_hour", 10_000, "US dollars per hour", usd_per_hour / 3
            ),
            accelerators={key: wanted.number(key, 1024, "devices") for key in wanted.children},
        )


def _named(section: Section, key: str, name: object, what: str) -> str:
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        said = f"{shown(name)} is not the name of {what}"
        hint = "use lower-case letters, digits and dashes"
        raise section.error(key, said, hint, at_key=key == name)
    return name
