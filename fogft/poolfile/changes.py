"""What a changed pool file changes, in words. Pure."""

from __future__ import annotations

from dataclasses import fields
from enum import Enum
from typing import Any

from fogft.model.groups import groups_of, replica_hash
from fogft.model.spec import HealthSpec, PoolSpec, ServiceSpec


def changes(before: PoolSpec, after: PoolSpec) -> list[str]:
    """Return one sentence for each difference, in the file's order; empty when there is none."""
    found = _task(before, after)
    found += _services(before, after)
    found += [
        _one(key, getattr(before, key), getattr(after, key))
        for key in ("replicas", "max_surge", "max_usd_per_hour", "max_hours")
        if getattr(before, key) != getattr(after, key)
    ]
    for key in (
        "availability",
        "placement",
        "on_demand",
        "groups",
        "schedule",
        "migration",
        *("topology", "uplinks", "metrics", "topics", "rmw"),
    ):
        found += _section(key, getattr(before, key), getattr(after, key))
    found += [
        _one(f"health.{f.name}", getattr(before.health, f.name), getattr(after.health, f.name))
        for f in fields(HealthSpec)
        if getattr(before.health, f.name) != getattr(after.health, f.name)
    ]
    return found


def replaces_replicas(before: PoolSpec, after: PoolSpec) -> bool:
    """Whether running replicas are replaced, because what they run or serve has changed."""
    slots = {group.first_slot for spec in (before, after) for group in groups_of(spec)}
    return any(replica_hash(before, slot) != replica_hash(after, slot) for slot in slots)


def _task(before: PoolSpec, after: PoolSpec) -> list[str]:
    keys = [*after.task, *(key for key in before.task if key not in after.task)]
    found = []
    for key in keys:
        old, new = before.task.get(key), after.task.get(key)
        if old == new:
            continue
        if old is None or new is None:
            found.append(f"`{key}` {'added' if old is None else 'removed'}")
        elif _is_short(old) and _is_short(new):
            found.append(_one(key, old, new))
        else:
            found.append(f"`{key}` changed")
    return found


def _services(before: PoolSpec, after: PoolSpec) -> list[str]:
    old = {service.name: service for service in before.services}
    new = {service.name: service for service in after.services}
    found = [f"service `{name}` added" for name in new if name not in old]
    found += [f"service `{name}` removed" for name in old if name not in new]
    for name, service in new.items():
        if name in old:
            found += [
                _one(f"service `{name}`: {f.name}", was, is_)
                for f in fields(ServiceSpec)
                if (was := getattr(old[name], f.name)) != (is_ := getattr(service, f.name))
            ]
    return found


def _section(key: str, before: Any, after: Any) -> list[str]:
    if before == after:
        return []
    if before and after:
        return [f"`{key}` changed"]
    return [f"`{key}` {'added' if after else 'removed'}"]


def _one(what: str, before: Any, after: Any) -> str:
    name = what if "`" in what else f"`{what}`"
    return f"{name}: {_shown(before)} -> {_shown(after)}"


def _shown(value: Any) -> str:
    if value is None or value == "":
        return "none"
    if isinstance(value, Enum):
        return str(value.value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _is_short(value: Any) -> bool:
    return isinstance(value, (str, int, float)) and len(str(value)) <= 40 and "\n" not in str(value)
