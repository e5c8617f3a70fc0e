"""Machines of this user's pools that no manager owns, and their end on request.

A manager owns a machine while it holds its pool's lock on this computer. Whatever else is
listed costs money that nobody watches: the pool's folder was lost, its manager was ended for
good, or `down` was cut short.

Owns: who owns what.
Not here: what exists (`fogft.cloud`, past every memory) and asking the user (`fogft.cli`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fogft import disk
from fogft.cloud.port import Audit, Auditing, Cloud
from fogft.errors import CloudError, FogftError, PoolNotFound
from fogft.model.replica import Machine
from fogft.pool.commands.composition import LOCAL, SKY, make_cloud
from fogft.pool.folder import known_pools
from fogft.pool.folder.paths import PoolPaths, home
from fogft.pool.folder.store import read_identity


@dataclass(frozen=True)
class Unowned:
    """A machine that nobody looks after.

    Attributes:
        pool: Its pool's name; empty where there is none of its uid here.
        why: Why it is nobody's, in words.
    """

    machine: Machine
    pool: str
    why: str


@dataclass(frozen=True)
class Swept:
    """What was found in one cloud.

    Attributes:
        cloud: Its name, one of `composition.CLOUDS`.
        asked: Clouds whose own list was read.
    """

    cloud: str
    unowned: Sequence[Unowned]
    asked: frozenset[str]


def clouds_used() -> list[str]:
    """Return the clouds where this user's machines can be, as far as is known here."""
    return [LOCAL, *([SKY] if (home() / SKY).exists() else [])]


def sweep_cloud(cloud: str) -> Swept:
    """Return the machines of this user's pools in a cloud that no manager owns.

    Raises:
        CloudUnreachable: It cannot tell what exists.
        CloudError: There is no such cloud, or it is not usable here.
    """
    concrete = make_cloud(cloud, Path.cwd())
    if not isinstance(concrete, Auditing):
        raise FogftError(f"cloud `{cloud}` cannot be swept")
    unowned, audit = find(concrete, home())
    return Swept(cloud, unowned, audit.asked)


def find(cloud: Auditing, root: Path) -> tuple[list[Unowned], Audit]:
    """Return the machines that no manager owns, and what was asked for them.

    Args:
        cloud: Where to look.
        root: The state folder with this user's pools.

    Raises:
        CloudUnreachable: It cannot tell what exists.
        StateError: A pool's identity cannot be read, so that its machines are not known.
    """
    audit = cloud.audit()
    pools = _pools(root)  # after the audit: a pool made meanwhile is known by then
    found = []
    for machine in audit.machines:
        pool, managed = pools.get(machine.id.pool_uid, ("", False))
        if not managed:
            why = f"pool `{pool}` has no manager" if pool else f"no pool of this uid in `{root}`"
            found.append(Unowned(machine, pool, why))
    return found, audit


def end_found(found: Swept, told: Callable[[str], None]) -> list[FogftError]:
    """End what was found in a cloud, as `end` does; return what went wrong."""
    return end(make_cloud(found.cloud, Path.cwd()), found.unowned, home(), told=told)


def end(
    cloud: Cloud,
    unowned: Iterable[Unowned],
    root: Path,
    *,
    told: Callable[[str], None],
) -> list[FogftError]:
    """End machines, one after the other; return what went wrong.

    One that a manager has taken over meanwhile is left alone.
    """
    problems: list[FogftError] = []
    for one in unowned:
        id = one.machine.id
        if _pools(root).get(id.pool_uid, ("", False))[1]:
            told(f"`{id}` is left alone: its pool has a manager again")
            continue
        try:
            cloud.terminate(id)
        except CloudError as error:
            problems.append(error)
        else:
            told(f"ended `{id}` ({one.machine.placement.location})")
    return problems


def usd_per_hour(unowned: Sequence[Unowned]) -> float:
    """Return what they cost together, as far as it is known."""
    return sum(one.machine.usd_per_hour for one in unowned)


def _pools(root: Path) -> dict[str, tuple[str, bool]]:
    """Return uid -> name and whether a manager is in office, of the pools here.

    Raises:
        StateError: A pool's identity cannot be read: its machines would look like nobody's.
    """
    found = {}
    for name in known_pools.names(root):
        paths = PoolPaths.of(name, root)
        try:
            uid = read_identity(paths).uid
        except PoolNotFound:  # ended meanwhile
            continue
        found[uid] = (name, disk.is_locked(paths.manager_lock))
    return found
