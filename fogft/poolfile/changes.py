"""What a changed pool file changes, in words. Pure."""

from __future__ import annotations

from dataclasses import fields
from enum import Enum
from typing import Any

from fogft.model import keys
from fogft.model.groups import groups_of, replica_hash
from fogft.model.keys import keys_of
from fogft.model.spec import PoolSpec


def changes(before: PoolSpec, after: PoolSpec) -> list[str]:
    """Return one sentence for each difference, in the file's order; empty when there is none."""
    found = _task(before, after) + _services(before, after)
    for entry in keys_of(PoolSpec):
        old, new = getattr(before, entry.field), getattr(after, entry.field)
        if entry.name == "health":
            found += _fields("health.{}", old, new)
        elif old == new or entry.name == "services":
            continue
        elif isinstance(entry.key.form, (keys.Number, keys.Whole, keys.Text)):
            found.append(_one(entry.name, old, new))
        elif old and new:
            found.append(f"`{entry.name}` changed")
        else:
            found.append(f"`{entry.name}` {'added' if new else 'removed'}")
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
    for name in [name for name in new if name in old]:
        found += _fields(f"service `{name}`: {{}}", old[name], new[name])
    return found


def _fields(what: str, before: Any, after: Any) -> list[str]:
    return [
        _one(what.format(f.name), was, is_)
        for f in fields(before)
        if (was := getattr(before, f.name)) != (is_ := getattr(after, f.name))
    ]


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
