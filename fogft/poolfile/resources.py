"""What a task's `resources` section says of places, as SkyPilot reads it. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any


def alternatives(resources: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield every alternative of a section, each whole, with its key."""
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
