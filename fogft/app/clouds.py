"""Which cloud, which store, which pool: the one place that picks concrete adapters."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from fogft.errors import CloudError
from fogft.pool.folder.paths import PoolPaths, home

if TYPE_CHECKING:
    from fogft.cloud.port import Cloud
    from fogft.pool.folder.store import Identity, PoolStore

LOCAL = "local"
SKY = "sky"
CLOUDS = (LOCAL, SKY)


def pools() -> list[str]:
    """Return the names of the pools on this machine, sorted."""
    from fogft.pool.folder import known_pools

    return known_pools.names(home())


def pool_name(name: str | None = None) -> str:
    """Return the pool that is meant: the one named, else the only one there is.

    Raises:
        PoolNotFound: There is no such pool, none, or more than one to choose from.
    """
    from fogft.pool.folder import known_pools

    return known_pools.meant(home(), name)


def make_cloud(name: str, base: Path) -> Cloud:
    """Return a cloud by name.

    Args:
        name: One of `CLOUDS`.
        base: Folder of the pool file: relative paths in it start there.

    Raises:
        CloudError: There is no such cloud.
    """
    if name not in CLOUDS:
        known = ", ".join(f"`{cloud}`" for cloud in CLOUDS)
        raise CloudError(
            f"there is no cloud `{name}`",
            f"there are: {known}; `sky` stands for all real ones, which the pool file names",
        )
    if name == SKY:
        from fogft.cloud import sky

        return sky.make(home() / "sky", base)
    from fogft.cloud.local.cloud import LocalCloud

    return LocalCloud(local_root())


def cloud_of(identity: Identity) -> Cloud:
    """Return the cloud that a pool runs on.

    Raises:
        CloudError: This version knows no such cloud.
    """
    return make_cloud(identity.cloud, Path(identity.file).parent)


def costs_money(pool: str) -> bool:
    """Whether a pool's machines are paid for.

    Raises:
        PoolNotFound: There is no such pool.
    """
    return make_store(pool).identity().cloud != LOCAL


def make_store(pool: str) -> PoolStore:
    """Return the store of a pool."""
    from fogft.pool.folder.store import PoolStore
    from fogft.poolfile.file import parse

    return PoolStore(
        PoolPaths.of(pool),
        lambda text, file: parse(text, file=file),
        time.time,
    )


def cloud_names() -> dict[str, str]:
    """Return which cloud of `CLOUDS` each name stands for that a pool file can name."""
    from fogft.model.clouds import NO_VM_CLOUDS, VM_CLOUDS

    return {LOCAL: LOCAL, **dict.fromkeys((*VM_CLOUDS, *NO_VM_CLOUDS), SKY)}


def local_root() -> Path:
    """Return where the local cloud keeps its machines."""
    return home() / "local"
