"""Groups of replicas within one pool, and their slots. Pure.

A pool file without groups has a single one. A slot identifies its group: group k has the slots from
``k * BLOCK`` on; the upper half of a block, from `STAND_INS` on, is for on-demand machines that
stand in for spot ones.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fogft.model.choices import GroupSpec
from fogft.model.replica import Machine
from fogft.model.spec import PoolSpec

BLOCK = 200
MAX_GROUPS = 8
STAND_INS = BLOCK // 2
# The manager uses only lower slots; replicas started by hand use this one and those above.
FIRST_BY_HAND = 2000
GATEWAY_SLOT = FIRST_BY_HAND - 1  # the machine of the gateway that a pool launches for itself
LAST_BY_HAND = 999_999
PLACE_KEYS = ("infra", "cloud", "region", "zone")  # of `resources` and each of its alternatives


@dataclass(frozen=True)
class Group(GroupSpec):
    """A group of replicas; its name is empty if the pool file has no groups."""

    block: int = 0

    @property
    def first_slot(self) -> int:
        """The lowest slot of the group."""
        return self.block * BLOCK

    def owns(self, slot: int) -> bool:
        """Whether a slot belongs to the group."""
        return slot // BLOCK == self.block


def slots_hint(slot: int, used: Iterable[int]) -> str:
    """Return the hint where no machine is in a slot: where to look, or the slots in use."""
    if slot >= FIRST_BY_HAND:
        return f"replicas from slot {FIRST_BY_HAND} on are started by hand: use their own machine"
    return f"slots in use: {', '.join(map(str, sorted(set(used)))) or 'none'}"


def is_stand_in(slot: int) -> bool:
    """Whether a slot belongs to an on-demand stand-in for a spot machine."""
    return slot % BLOCK >= STAND_INS


def group_of(groups: Sequence[Group], slot: int) -> Group:
    """Return the group of a slot; the last group if no group has it."""
    return next((group for group in groups if group.owns(slot)), groups[-1])


def groups_of(spec: PoolSpec) -> tuple[Group, ...]:
    """Return a pool's groups, in the order of their slots."""
    known: tuple[Group, ...] | None = spec.derived.get("groups")
    if known is None:
        resources = spec.task.get("resources") or {}
        known = tuple(Group(**vars(one), block=block) for block, one in enumerate(spec.groups)) or (
            Group("", spec.replicas, resources, spec.on_demand),
        )
        spec.derived["groups"] = known
    return known


def replica_hash(spec: PoolSpec, slot: int) -> str:
    """Return the expected hash of a replica in this slot; see `PoolSpec.replica_hash`."""
    key = "hash", slot // BLOCK
    found: str | None = spec.derived.get(key)
    if found is None:
        group = group_of(groups_of(spec), slot)
        found = spec.derived[key] = spec.hash_with(group.resources)
    return found


def is_current(spec: PoolSpec, machine: Machine) -> bool:
    """Whether a machine runs what the pool file asks for now."""
    return machine.spec_hash == replica_hash(spec, machine.id.slot)


def task_at(spec: PoolSpec, slot: int) -> dict[str, Any]:
    """Return the task of a slot's replica: the file's task with its group's resources."""
    if not spec.groups:
        return dict(spec.task)
    return {**spec.task, "resources": dict(group_of(groups_of(spec), slot).resources)}


def sales(spec: PoolSpec) -> tuple[tuple[str, Mapping[str, Any]], ...]:
    """Return the resources to price, by group name; two entries for a group that mixes markets."""
    found: list[tuple[str, Mapping[str, Any]]] = []
    for group in groups_of(spec):
        if group.on_demand.base or group.on_demand.fallback:
            found += [(group.name, with_spot(group.resources, spot)) for spot in (True, False)]
        else:
            found.append((group.name, group.resources))
    return tuple(found)


def overridden(resources: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return `resources` with the keys of `own`; a place in `own` replaces every other place."""
    out = dict(resources)
    if any(key in own for key in PLACE_KEYS):
        out = _without_place(out, own)
        for key in {"any_of", "ordered"} & out.keys():
            out[key] = [_without_place(one, own) for one in out[key] or ()]
    return {**out, **own}


def _without_place(resources: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return `resources` without their place, except for the cloud if `own` names none."""
    out = {key: value for key, value in resources.items() if key not in PLACE_KEYS}
    cloud = resources.get("cloud") or str(resources.get("infra") or "").partition("/")[0]
    if cloud not in ("", "*") and not {"infra", "cloud"} & own.keys():
        out["cloud"] = cloud
    return out


def with_spot(resources: Mapping[str, Any], spot: bool) -> dict[str, Any]:
    """Return a `resources` section restricted to spot machines, or to on-demand ones."""
    out = {**resources, "use_spot": spot}
    for key in ("any_of", "ordered"):
        if out.get(key):
            out[key] = [{**one, "use_spot": spot} for one in out[key]]
    return out


def shares(groups: tuple[Group, ...], total: int) -> tuple[int, ...]:
    """Distribute replicas over groups as in the file; the last groups change first."""
    counts = [group.replicas for group in groups]
    counts[-1] += max(0, total - sum(counts))
    for index in reversed(range(len(counts))):
        excess = sum(counts) - total
        counts[index] -= min(counts[index], max(0, excess))
    return tuple(counts)
