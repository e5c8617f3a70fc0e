"""Find and end machines of this user's pools that no manager owns.

A manager owns a machine while it holds the pool's lock on this computer. All other machines that
are listed cost money unnoticed.

Not here: listing machines (`fogft.cloud`, without any cache) and asking the user (`fogft.cli`).
"""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fogft import disk
from fogft.cloud.port import Auditing, Cloud
from fogft.errors import CloudError, FogftError, PoolNotFound, StateError
from fogft.model.replica import Machine
from fogft.pool.commands.composition import LOCAL, SKY, make_cloud, pools
from fogft.pool.folder.paths import PoolPaths, home
from fogft.pool.folder.store import Identity, read_identity

_NAMED = 5  # machines in a message


@dataclass(frozen=True)
class Unowned:
    """A machine without a manager."""

    machine: Machine
    why: str
    known: bool


@dataclass(frozen=True)
class Swept:
    """The machines found in one cloud."""

    cloud: str  # one of `composition.CLOUDS`
    unowned: Sequence[Unowned]
    asked: frozenset[str]


def clouds_used() -> list[str]:
    """Return the clouds known to this machine that may have this user's machines."""
    return [LOCAL, *([SKY] if (home() / SKY).exists() else [])]


def sweep_cloud(name: str, cloud: Cloud | None = None) -> Swept:
    """Return the machines in a cloud that belong to this user's pools but have no manager."""
    cloud = cloud or make_cloud(name)
    if not isinstance(cloud, Auditing):
        raise FogftError(f"cloud `{name}` cannot be swept")
    audit = cloud.audit()
    known = _pools()  # after the audit: a pool made meanwhile is known by then
    found = []
    for machine in audit.machines:
        pool, managed = known.get(machine.id.pool_uid, ("", False))
        if not managed:
            named = f" (`{machine.pool}`)" if machine.pool else ""
            lost = f"no pool of this uid{named} in `{home()}`"
            why = f"pool `{pool}` has no manager" if pool else lost
            found.append(Unowned(machine, why, bool(pool)))
    return Swept(name, found, audit.asked)


def left_of(pool: str, name: str, cloud: Cloud) -> list[str]:
    """Return a warning about running machines of an earlier pool of this name; else empty.

    That pool's keys were in its folder, which is lost: no manager can take over its machines.
    """
    try:
        found = [one.machine for one in sweep_cloud(name, cloud).unowned if not one.known]
    except FogftError as error:
        return [f"cannot tell now whether machines of an earlier `{pool}` run: {error.message}"]
    left = [machine for machine in found if machine.pool.casefold() in ("", pool.casefold())]
    if not left:
        return []
    usd_per_hour = sum(machine.usd_per_hour for machine in left)
    ids = ", ".join(f"`{machine.id}`" for machine in left[:_NAMED])
    more = f" and {len(left) - _NAMED} more" if len(left) > _NAMED else ""
    return [
        f"machines of an earlier pool are running, at ${usd_per_hour:.3f}/h in total: {ids}{more}. "
        "Its folder and keys are lost: `fogft sweep --end` ends them"
    ]


def end_found(found: Swept, told: Callable[[str], None]) -> list[FogftError]:
    """End machines one by one, except those that have a manager again; return the errors."""
    cloud = make_cloud(found.cloud)
    problems: list[FogftError] = []
    for one in found.unowned:
        id = one.machine.id
        if _pools().get(id.pool_uid, ("", False))[1]:
            told(f"`{id}` was left alone: its pool has a manager again")
            continue
        try:
            cloud.terminate(id)
        except (CloudError, StateError) as error:
            problems.append(error)
        else:
            told(f"ended `{id}` ({one.machine.placement.location})")
    return problems


def _pools() -> dict[str, tuple[str, bool]]:
    """Return uid -> name and whether it has a manager, for pools here and exported ones."""
    found = {}
    for folder in (home() / "pools").glob("*"):
        with contextlib.suppress(StateError):
            if (moved := disk.read_as(Identity, PoolPaths(folder).exported)) is not None:
                found[moved.uid] = (moved.name, True)
    for name in pools():
        paths = PoolPaths.of(name)
        try:
            uid = read_identity(paths).uid
        except PoolNotFound:  # ended meanwhile
            continue
        found[uid] = (name, disk.is_locked(paths.manager_lock))
    return found
