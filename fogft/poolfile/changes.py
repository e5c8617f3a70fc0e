"""The differences between two pool files, in words. Pure."""

from collections.abc import Mapping
from typing import Any

from fogft.model.groups import groups_of, replica_hash
from fogft.model.keys import keys_of
from fogft.model.plain import to_plain
from fogft.model.spec import PoolSpec


def changes(before: PoolSpec, after: PoolSpec) -> list[str]:
    """Return one sentence for each difference; empty when there is none."""
    old, new = _ours(before), _ours(after)
    was, is_ = ({one["name"]: one for one in ours.pop("services")} for ours in (old, new))
    return [
        *_differences(before.task, after.task),
        *_differences(was, is_, "service ", inside=True),
        *_differences(old, new, inside=True),
    ]


def replaces_replicas(before: PoolSpec, after: PoolSpec) -> bool:
    """Whether running replicas are replaced, because what they run or serve has changed."""
    slots = {group.first_slot for spec in (before, after) for group in groups_of(spec)}
    return any(replica_hash(before, slot) != replica_hash(after, slot) for slot in slots)


def _ours(spec: PoolSpec) -> dict[str, Any]:
    plain = to_plain(spec)
    return {entry.name: plain[entry.name] for entry in keys_of(PoolSpec)}


def _differences(
    before: Mapping[str, Any], after: Mapping[str, Any], kind: str = "", *, inside: bool = False
) -> list[str]:
    """Return the differences between two maps, and within their nested maps if `inside`."""
    found = []
    for key in [*after, *(key for key in before if key not in after)]:
        old, new = before.get(key), after.get(key)
        if old == new:
            continue
        what = f"{kind}`{key}`"
        if inside and isinstance(old, Mapping) and isinstance(new, Mapping):
            found += [f"{what}: {one}" for one in _differences(old, new)]
        elif _is_short(old) and _is_short(new):
            found.append(f"{what}: {_shown(old)} -> {_shown(new)}")
        else:
            found.append(f"{what} {'changed' if old and new else 'added' if new else 'removed'}")
    return found


def _shown(value: Any) -> str:
    if value is None or value == "":
        return "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _is_short(value: Any) -> bool:
    is_one = value is None or isinstance(value, (str, int, float))
    return is_one and len(str(value)) <= 40 and "\n" not in str(value)
