"""The manager's lease: one holder per pool, an epoch for each holder, and a heartbeat.

A machine that imports a pool counts epochs from a random later term, so if two machines import
copies, everybody agrees which one is later.

Owns: `manager.lock` and `lease.json`.
"""

import secrets
from dataclasses import dataclass

from fogft import disk
from fogft.errors import PoolBusy
from fogft.model.plain import Count, to_plain
from fogft.pool.folder.paths import PoolPaths

TERM = 1 << 20  # epochs of one machine; an import may skip as many terms


@dataclass(frozen=True)
class _Held:
    epoch: Count = 0
    beat: Count = 0


class Lease:
    """The lease of one pool, held until `release` or the end of the process.

    Its epoch is above all earlier ones and `at_least`. Raises PoolBusy: another manager holds it.
    """

    def __init__(self, paths: PoolPaths, *, at_least: int = 0) -> None:
        self._paths = paths
        self._lock = lock = disk.Lock(paths.manager_lock)
        self.release = lock.release  # gives the lease back; repeatable
        try:
            taken = lock.acquire(wait=False)
        except OSError as error:
            raise disk.not_done("opened", paths.manager_lock, error) from error
        if not taken:
            said = (disk.read_bytes(paths.manager_lock) or b"").decode("latin-1")
            who = f" (pid {said})" if said.isascii() and said.isdecimal() else ""
            raise PoolBusy(f"pool `{paths.folder.name}` already has a manager{who}")
        self.epoch = max(read_epoch(paths), at_least) + 1
        self._beat = 0
        self._write()

    def beat(self) -> None:
        """Write the heartbeat. Raises PoolBusy: a later manager took over, so stop at once."""
        folder = self._paths.folder
        if (self._lock.lost and folder.exists()) or read_epoch(self._paths) > self.epoch:
            raise PoolBusy(f"a later manager has taken over pool `{folder.name}`")
        self._beat += 1
        self._write()

    def _write(self) -> None:
        held = _Held(self.epoch, self._beat)
        disk.write_json(self._paths.lease, to_plain(held), durable=self._beat == 0)


def read_epoch(paths: PoolPaths) -> int:
    """Return the epoch of the manager that held the lease last; 0 for none, or a damaged file."""
    return disk.read_or(paths.lease, _Held()).epoch


def next_term(after: int) -> int:
    """Return the first epoch of a machine that imports a pool."""
    return (after // TERM + 1 + secrets.randbelow(TERM)) * TERM


def supersedes(heard: int, ours: int) -> bool:
    """Whether an epoch belongs to a machine that imported the pool later than ours."""
    return heard // TERM > ours // TERM
