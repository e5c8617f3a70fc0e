"""Which cloud, which store, which pool: the one place that picks concrete adapters."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from fogft.core.errors import CloudError
from fogft.pool.paths import PoolPaths, home

if TYPE_CHECKING:
    from fogft.cloud.port import Cloud
    from fogft.pool.store import PoolStore

CLOUDS = ("local",)


def pools() -> list[str]:
    """Return the names of the pools on this machine, sorted."""
    from fogft.pool import known

    return known.names(home())


def pool_name(name: str | None = None) -> str:
    """Return the pool that is meant: the one named, else the only one there is.

    Raises:
        PoolNotFound: There is no such pool, none, or more than one to choose from.
    """
    from fogft.pool import known

    return known.meant(home(), name)


def make_cloud(name: str) -> Cloud:
    """Return a cloud by name.

    Raises:
        CloudError: There is no such cloud, or it is not supported yet.
    """
    if name not in CLOUDS:
        raise CloudError(
            f"cloud `{name}` is not supported yet",
            f"supported: {', '.join(f'`{c}`' for c in CLOUDS)}",
        )
    from fogft.cloud.local.cloud import LocalCloud

    return LocalCloud(local_root())


def make_store(pool: str) -> PoolStore:
    """Return the store of a pool."""
    from fogft.pool import pool_file
    from fogft.pool.store import PoolStore

    return PoolStore(
        PoolPaths.of(pool),
        lambda text, file: pool_file.parse(text, file=file),
        time.time,
    )


def local_root() -> Path:
    """Return where the local cloud keeps its machines."""
    return home() / "local"
