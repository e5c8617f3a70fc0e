"""The composition root: the one place that picks the concrete cloud and store of a pool.

Owns: which adapter stands behind a cloud's name, and which pool a command is about.
Not here: what a command does to a pool (its siblings).
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from fogft.errors import CloudError, PoolNotFound
from fogft.pool.folder.paths import PoolPaths, home

if TYPE_CHECKING:
    from fogft.cloud.port import Cloud
    from fogft.pool.folder.store import Identity, PoolStore

LOCAL = "local"
SKY = "sky"
CLOUDS = (LOCAL, SKY)


def pools(*, exported: bool = False) -> list[str]:
    """Return the names of the pools on this machine, or of those exported from it, sorted."""
    try:
        folders = list((home() / "pools").iterdir())
    except FileNotFoundError:
        return []
    kept = [one.exported if exported else one.identity for one in map(PoolPaths, folders)]
    return sorted(one.parent.name for one in kept if one.exists())


def paths_of(name: str | None = None) -> PoolPaths:
    """Return the paths of the named pool, or of the only one."""
    known = pools() or pools(exported=True)
    listed = ", ".join(f"`{pool}`" for pool in known)
    if name is None and len(known) > 1:
        raise PoolNotFound(f"there are {len(known)} pools: {listed}", "name one with `--pool NAME`")
    if name is not None and name not in known and not PoolPaths.of(name).exported.exists():
        hint = f"pools: {listed}" if known else "start one with `fogft up FILE`"
        raise PoolNotFound(f"there is no pool `{name}`", hint)
    if name is None and not known:
        raise PoolNotFound("no pools on this machine", "start one with `fogft up FILE`")
    return PoolPaths.of(name or known[0])


def store_of(name: str | None = None) -> PoolStore:
    """Return the store of the named pool, or of the only one; see `paths_of`."""
    return make_store(paths_of(name).folder.name)


def make_store(pool: str) -> PoolStore:
    """Return the store of a pool, which need not exist yet."""
    from fogft.pool.folder.store import PoolStore
    from fogft.poolfile.file import parse

    return PoolStore(PoolPaths.of(pool), lambda text, file: parse(text, file=file), time.time)


def make_cloud(name: str) -> Cloud:
    """Return a cloud, one of `CLOUDS`."""
    if name not in CLOUDS:
        known = ", ".join(f"`{cloud}`" for cloud in CLOUDS)
        raise CloudError(
            f"there is no cloud `{name}`",
            f"clouds: {known}; `sky` stands for the real clouds that the pool file names",
        )
    if name == SKY:
        from fogft.cloud.sky import adapter

        return adapter.make(home() / SKY)
    from fogft.cloud.local.cloud import LocalCloud

    return LocalCloud(home() / LOCAL)


def cloud_of(identity: Identity) -> Cloud:
    """Return the cloud that a pool runs on."""
    return make_cloud(identity.cloud)
