"""Read ``regions.yaml``: a local cloud other than the built-in one. Every key is optional::

boot_s: 0.5                  # of every zone that does not say otherwise, as are the
notice_s: 5                  # four keys below
capacity: 8
price_factor: 1.0
relay: true
instances:                   # instead of the built-in ones
  cpu4: {cpus: 4, memory_gb: 16, usd_per_hour: 0.19, spot_usd_per_hour: 0.07}
  gpu:  {cpus: 8, memory_gb: 32, usd_per_hour: 0.7, spot_usd_per_hour: 0.3,
         accelerators: {L4: 1}}
regions:                     # instead of the built-in ones
  us-west-1: {zones: [a, b], boot_s: 0.3}
  moon-1: {zones: {dark: {capacity: 1}, bright: {}}, price_factor: 9}
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from fogft.cloud.local.catalogue import BUILT_IN, Catalogue, Instance, Zone
from fogft.errors import SpecError
from fogft.poolfile.tree import Section, plain, shown

FILE = "regions.yaml"
ZONE_KEYS = ("boot_s", "notice_s", "capacity", "price_factor", "relay")
INSTANCE_KEYS = ("cpus", "memory_gb", "usd_per_hour", "spot_usd_per_hour", "accelerators")
_NAME = re.compile(r"[a-z0-9]([a-z0-9-]{0,38}[a-z0-9])?")


def read(path: Path) -> Catalogue:
    """Return what a file describes, or the built-in catalogue where there is none.

    Raises:
        SpecError: The first mistake in it, as ``file:line: key: what is wrong``.
    """
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
        _check_name(section, name, "region")
        region = section.section(name, "write `{zones: [a, b]}`")
        region.only((*ZONE_KEYS, "zones"))
        here = replace(_zone(region, default), region=name)
        zones = region.children.get("zones")
        if zones is None or isinstance(zones.value, tuple):
            for zone in plain(zones) if zones else ["a"]:
                yield replace(here, name=_zone_name(region, zone))
        else:
            below = region.section("zones", "write `[a, b]` or `{a: {capacity: 2}}`")
            for zone in below.children:
                settings = below.section(zone, "write `{capacity: 2}` or `{}`")
                settings.only(ZONE_KEYS)
                yield replace(_zone(settings, here), name=_zone_name(region, zone))


def _zone(section: Section, default: Zone) -> Zone:
    relay = section.children.get("relay")
    if relay is not None and not isinstance(relay.value, bool):
        what = f"must be true or false, not {shown(relay.value)}"
        raise section.error("relay", what, "write `relay: true`")
    return replace(
        default,
        boot_s=section.number("boot_s", 86_400, "seconds", default.boot_s),
        notice_s=section.number("notice_s", 86_400, "seconds", default.notice_s),
        capacity=section.whole("capacity", default.capacity, 0, 10_000),
        price_factor=section.number("price_factor", 1000, "times", default.price_factor),
        relay=default.relay if relay is None else bool(relay.value),
    )


def _instances(section: Section) -> Iterator[Instance]:
    for name in section.children:
        _check_name(section, name, "instance")
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


def _zone_name(section: Section, name: object) -> str:
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        what = f"{shown(name)} is not the name of a zone"
        raise section.error("zones", what, "use lower-case letters, digits and dashes")
    return name


def _check_name(section: Section, name: str, what: str) -> None:
    if not _NAME.fullmatch(name):
        hint = "use lower-case letters, digits and dashes"
        raise section.error(name, f"is not the name of a {what}", hint, at_key=True)
