"""Kinds of replicas within one pool, and which slots are whose. Pure.

A group has machines of its own kind: a small on-demand one for up-time, large spot ones for
speed. Where the pool file names no groups there is one. A service that asks for more replicas
than the pool has gets a group of its own, `CRITICAL`, whose replicas carry such services
alone.

Slots tell the groups apart, so nothing else has to be remembered: group k has the slots
from ``k * BLOCK`` on, `CRITICAL` the last block; the upper half of a block, from `STAND_INS` on,
is for on-demand machines that stand in for spot ones. From `FIRST_BY_HAND` on they are free for
replicas that people start themselves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fogft.model.choices import OnDemandSpec
from fogft.model.spec import PoolSpec, ServiceSpec

BLOCK = 100
MAX_GROUPS = 8
CRITICAL_BLOCK = 9
STAND_INS = 50
CRITICAL = "critical"
# The manager launches all slots below; replicas that people start by hand stay out of its way.
FIRST_BY_HAND = (CRITICAL_BLOCK + 1) * BLOCK
LAST_BY_HAND = 999_999


@dataclass(frozen=True)
class Group:
    """One kind of replicas.

    Attributes:
        name: Empty where the pool file names no groups.
        offers: The name that offers for it carry: another group's for `CRITICAL`.
        block: Which slots are its own.
    """

    name: str
    offers: str
    block: int
    replicas: int
    resources: Mapping[str, Any]
    on_demand: OnDemandSpec
    services: tuple[ServiceSpec, ...]

    @property
    def first_slot(self) -> int:
        """Its lowest slot."""
        return self.block * BLOCK

    @property
    def first_stand_in(self) -> int:
        """The lowest slot of its on-demand machines that stand in for spot ones."""
        return self.first_slot + STAND_INS

    def owns(self, slot: int) -> bool:
        """Whether a slot is one of its own."""
        return slot // BLOCK == self.block


def is_stand_in(slot: int) -> bool:
    """Whether a slot is that of an on-demand machine that stands in for a spot one."""
    return slot % BLOCK >= STAND_INS


def group_of(groups: Sequence[Group], slot: int) -> Group:
    """Return the group that a slot's replica counts for: its own, else the last ordinary one."""
    if len(groups) == 1:
        return groups[0]
    ordinary = [group for group in groups if group.name != CRITICAL]
    return next((group for group in groups if group.owns(slot)), ordinary[-1])


def groups_of(spec: PoolSpec) -> tuple[Group, ...]:
    """Return a pool's groups, in the order of their slots; `CRITICAL` is not among them."""
    if "groups" not in spec.derived:
        spec.derived["groups"] = _groups_of(spec)
    groups: tuple[Group, ...] = spec.derived["groups"]
    return groups


def _groups_of(spec: PoolSpec) -> tuple[Group, ...]:
    if not spec.groups:
        resources = spec.task.get("resources") or {}
        kind = Group("", "", 0, spec.replicas, resources, spec.on_demand, spec.services)
        return (kind,)
    return tuple(
        Group(g.name, g.name, block, g.replicas, g.resources, g.on_demand, spec.services)
        for block, g in enumerate(spec.groups)
    )


def critical_services(spec: PoolSpec) -> tuple[ServiceSpec, ...]:
    """Return the services that ask for a number of replicas of their own."""
    return tuple(service for service in spec.services if service.min_replicas)


def critical_group(spec: PoolSpec, wanted: int) -> Group:
    """Return the group of those that carry critical services alone, beside `wanted` others."""
    key = CRITICAL, wanted
    if key not in spec.derived:
        last = groups_of(spec)[-1]
        most = max((service.min_replicas for service in spec.services), default=0)
        spec.derived[key] = Group(
            CRITICAL,
            last.offers,
            CRITICAL_BLOCK,
            max(0, most - wanted),
            last.resources,
            OnDemandSpec(0, last.on_demand.fallback),
            critical_services(spec) or spec.services,
        )
    group: Group = spec.derived[key]
    return group


def group_at(spec: PoolSpec, slot: int) -> Group:
    """Return the group that a slot belongs to; the last one for a slot of no group now."""
    key = "group", slot // BLOCK
    group: Group | None = spec.derived.get(key)
    if group is None:
        found = [*groups_of(spec), critical_group(spec, 0)]
        group = next((group for group in found if group.owns(slot)), found[-2])
        spec.derived[key] = group
    return group


def services_at(spec: PoolSpec, slot: int) -> tuple[ServiceSpec, ...]:
    """Return the services that the replica in a slot carries."""
    return group_at(spec, slot).services


def ready_at(spec: PoolSpec, slot: int) -> frozenset[str]:
    """Return the names of the services that make the replica in a slot ready; none for never."""
    key = "ready", slot // BLOCK
    found: frozenset[str] | None = spec.derived.get(key)
    if found is None:
        services = services_at(spec, slot) or spec.discovered
        found = spec.derived[key] = frozenset(service.name for service in services)
    return found


def replica_hash(spec: PoolSpec, slot: int) -> str:
    """Return the hash that a replica in this slot should have; see `PoolSpec.replica_hash`."""
    key = "hash", slot // BLOCK
    found: str | None = spec.derived.get(key)
    if found is None:
        group = group_at(spec, slot)
        found = spec.derived[key] = spec.hash_with(group.services, group.resources)
    return found


def task_at(spec: PoolSpec, slot: int) -> dict[str, Any]:
    """Return the task of the replica in a slot: its group's resources, all else the file's."""
    if not spec.groups:
        return dict(spec.task)
    return {**spec.task, "resources": dict(group_at(spec, slot).resources)}


def sales(spec: PoolSpec) -> tuple[tuple[str, Mapping[str, Any]], ...]:
    """Return what a cloud is to be asked prices for: a group's name, and resources.

    A group that mixes spot and on-demand is asked for twice.
    """
    found: list[tuple[str, Mapping[str, Any]]] = []
    for group in groups_of(spec):
        if group.on_demand.base or group.on_demand.fallback:
            found += [(group.offers, with_spot(group.resources, spot)) for spot in (True, False)]
        else:
            found.append((group.offers, group.resources))
    return tuple(found)


def with_spot(resources: Mapping[str, Any], spot: bool) -> dict[str, Any]:
    """Return a `resources` section that asks for spot machines only, or for none."""
    out = {**resources, "use_spot": spot}
    for key in ("any_of", "ordered"):
        if isinstance(out.get(key), list):
            out[key] = [
                {**one, "use_spot": spot} if isinstance(one, Mapping) else one for one in out[key]
            ]
    return out


def shares(groups: tuple[Group, ...], total: int) -> tuple[int, ...]:
    """Share replicas as the file says; what is more or less concerns the last groups first."""
    if len(groups) == 1:
        return (max(0, total),)
    counts = [group.replicas for group in groups]
    counts[-1] += max(0, total - sum(counts))
    for index in reversed(range(len(counts))):
        excess = sum(counts) - total
        counts[index] -= min(counts[index], max(0, excess))
    return tuple(counts)
