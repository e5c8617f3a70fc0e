"""What one can see of a pool, and of this machine."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from fogft import disk, logfile
from fogft.app.clouds import cloud_of, make_store, pools
from fogft.pool.folder.paths import PoolPaths, home

if TYPE_CHECKING:
    from fogft.doctor.finding import Finding
    from fogft.pool.commands.status import Seen


def manager_alive(pool: str) -> bool:
    """Whether a manager of this pool runs."""
    return disk.is_locked(PoolPaths.of(pool).manager_lock)


def file_of(pool: str) -> str:
    """Return the pool file that a pool was started from."""
    from fogft.pool.folder.store import read_identity

    return read_identity(PoolPaths.of(pool)).file


def status(pool: str) -> Seen:
    """Return what the manager last saw of a pool, how old it is, and who looks now."""
    from fogft.pool.commands import status

    return status.read(PoolPaths.of(pool), time.time())


def refresh(pool: str, limit_s: float = 15.0) -> Seen:
    """Have the manager look again; without one, ask the cloud and the client proxy's report.

    Raises:
        StateError: The manager did not look again within `limit_s`.
    """
    from fogft.pool.commands import status

    if manager_alive(pool):
        return status.renewed(PoolPaths.of(pool), limit_s)
    store = make_store(pool)
    return status.ask(store, cloud_of(store.identity()), time.time())


def slots(pool: str) -> list[int]:
    """Return the slots that hold a replica, sorted."""
    return sorted({replica.slot for replica in status(pool).status.replicas})


def locations(pool: str) -> list[str]:
    """Return where the replicas are: regions and zones, sorted."""
    zones = {replica.location for replica in status(pool).status.replicas}
    return sorted(zones | {zone.rsplit("/", 1)[0] for zone in zones})


def excluded(pool: str) -> list[str]:
    """Return the locations that are excluded now, sorted."""
    return sorted(make_store(pool).intent().excluded)


def logs(pool: str, slot: int | None = None) -> list[tuple[str, Path]]:
    """Return a pool's logs, each with its name: ``manager``, ``proxy``, ``slot.generation``."""
    from fogft.pool.commands import logs

    store = make_store(pool)
    return logs.find(store, cloud_of(store.identity()), slot)


def tail(path: Path, lines: int = 8) -> str:
    """Return the last lines of a log; empty where there is none."""
    return logfile.tail(path, lines=lines)


def doctor(file: Path | None = None) -> Iterator[Finding]:
    """Check this machine, ROS 2, a pool file and the pools here; yield findings as they come."""
    from fogft.doctor import checks, finding
    from fogft.poolfile.file import read

    spec = None if file is None else read(file)
    yield from finding.run(checks.ALL, finding.situation(home(), pools(), spec))
