"""Clouds and places named in a pool file's resources, with their lines."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from fogft.errors import SpecError
from fogft.model.names import NO_VM_CLOUDS, VM_CLOUDS
from fogft.model.spec import PoolSpec
from fogft.poolfile import yaml_tree
from fogft.poolfile.tree import below, nearest


def located(error: SpecError, source: str, file: Path) -> SpecError:
    """Return a cloud's error about a key, with its file and line."""
    path = re.findall(r"[^.\[\]]+", error.key)
    root = yaml_tree.tree(source, str(file))
    line = below(root, [int(part) if part.isdecimal() else part for part in path]).key_line
    message = f"{file}:{line}: {error.message}"
    return SpecError(message, error.hint, key=error.key, what=error.what, line=line)


def cloud_named_by(spec: PoolSpec, source: str, file: Path) -> str:
    """Return `sky` for a pool file whose resources name real clouds, else `local`."""
    known = {"local": "local", **dict.fromkeys((*VM_CLOUDS, *NO_VM_CLOUDS), "sky")}
    named = dict(_named_in(spec))
    for cloud, key in named.items():
        if cloud not in known:
            what = f"there is no cloud `{cloud}`"
            problem = SpecError.of_key(key, what, nearest(cloud, known))
            raise located(problem, source, file)
    by_adapter = {known[cloud]: cloud for cloud in sorted(named)}
    if len(by_adapter) > 1:
        listed = " and ".join(f"`{cloud}`" for cloud in sorted(by_adapter.values()))
        problem = SpecError.of_key(
            "resources",
            f"{listed} cannot be combined in one pool",
            "name real clouds only; `--cloud local` tries their regions on this machine",
        )
        raise located(problem, source, file)
    return next(iter(by_adapter), "local")


def clouds_named(spec: PoolSpec) -> list[str]:
    """Return the clouds that a pool file's resources name, sorted; empty if any will do."""
    return sorted({cloud for cloud, _ in _named_in(spec)})


def _named_in(spec: PoolSpec) -> Iterator[tuple[str, str]]:
    for index, group in enumerate(spec.groups):
        yield from _named(group.resources, f"fogft.groups[{index}].resources")
    if not spec.groups:
        yield from _named(spec.task.get("resources") or {}, "resources")


def _named(resources: Mapping[str, Any], key: str) -> Iterator[tuple[str, str]]:
    for name in ("infra", "cloud"):
        if isinstance(resources.get(name), str):
            cloud = resources[name].split("/")[0].strip().lower()
            if cloud not in ("", "*"):
                yield cloud, f"{key}.{name}"
    for name in ("any_of", "ordered"):
        for index, choice in enumerate(resources.get(name) or ()):
            yield from _named(choice, f"{key}.{name}[{index}]")


def alternatives(resources: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield each alternative of a `resources` section, merged with the shared keys, and its key."""
    base = {k: v for k, v in resources.items() if k not in ("any_of", "ordered")}
    found = [
        (f"resources.{key}[{index}]", entry)
        for key in ("any_of", "ordered")
        for index, entry in enumerate(resources.get(key) or ())
    ]
    for key, entry in found or [("resources", {})]:
        labels = {**(base.get("labels") or {}), **(entry.get("labels") or {})}
        yield key, {**base, **entry, **({"labels": labels} if labels else {})}


def place(entry: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return cloud, region and zone of an alternative, in lower case; empty for any."""
    infra = entry.get("infra")
    parts = (
        str(infra).split("/", 2) if infra else [entry.get(k) for k in ("cloud", "region", "zone")]
    )
    named = [str(part or "").strip().lower() for part in (*parts, "", "")]
    cloud, region, zone = ("" if part == "*" else part for part in named[:3])
    return cloud, region, zone


def sells(entry: Mapping[str, Any], cloud: str, region: str, zone: str) -> bool:
    """Whether an alternative allows a place."""
    there = (cloud.lower(), region.lower(), zone.lower())
    return all(asked in ("", own) for asked, own in zip(place(entry), there, strict=True))
