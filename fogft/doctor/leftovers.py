"""Checks for what forgotten pools and faults on purpose left behind."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from fogft.cloud.local import faults, processes
from fogft.doctor.finding import Check, Finding, Situation, ok, warn
from fogft.errors import FogftError
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import read_identity


def orphaned_processes(situation: Situation) -> Iterator[Finding]:
    """No replica of the local cloud runs without its pool."""
    uids = []
    for pool in situation.pools:
        with contextlib.suppress(FogftError):
            uids.append(read_identity(PoolPaths.of(pool, situation.home)).uid)
    owned = {pid for uid in uids for pid in processes.find(pool_uid=uid)}
    orphans = [pid for pid in processes.find() if pid not in owned]
    if not orphans:
        yield ok("leftovers", "no replicas without a pool")
        return
    yield warn(
        "leftovers",
        f"{len(orphans)} processes of replicas run whose pool is not in `{situation.home}`",
        "they belong to a pool in another state folder: set FOGFT_HOME to it, and `fogft down` "
        "ends the pool. If the folder is lost, they end after `unmanaged_max_hours`",
    )


def chaos(situation: Situation) -> Iterator[Finding]:
    """No faults injected by `fogft chaos` are in force."""
    broken = faults.read_cloud(situation.home / "local")
    found = [f"`{place}` is out" for place in broken.out(situation.now)]
    found += [
        f"`{place}` has room for {n} machines" for place, n in sorted(broken.capacity.items())
    ]
    if found:
        yield warn(
            "leftovers",
            f"`fogft chaos` is still in force, for every pool: {', '.join(found)}",
            "undo it with `fogft chaos clear`",
        )


CHECKS: tuple[Check, ...] = (orphaned_processes, chaos)
