"""Which pools there are on this machine, and which one is meant.

Owns: finding pools by their folders.
Not here: what is in a folder (`store`).
"""

from __future__ import annotations

from pathlib import Path

from fogft.errors import PoolNotFound


def names(root: Path) -> list[str]:
    """Return the names of the pools under a state folder, sorted."""
    try:
        return sorted(p.name for p in (root / "pools").iterdir() if (p / "pool.json").exists())
    except FileNotFoundError:
        return []


def meant(root: Path, name: str | None) -> str:
    """Return the pool that is meant: the one named, else the only one there is.

    Raises:
        PoolNotFound: There is no such pool, none, or more than one to choose from.
    """
    known = names(root)
    listed = ", ".join(f"`{pool}`" for pool in known)
    if name is None and len(known) == 1:
        return known[0]
    if name is None and known:
        raise PoolNotFound(f"there are {len(known)} pools: {listed}", "say which one you mean")
    if name is None:
        raise PoolNotFound("no pools on this machine", "start one with `fogft up FILE`")
    if name not in known:
        hint = f"there are: {listed}" if known else "start one with `fogft up FILE`"
        raise PoolNotFound(f"there is no pool `{name}`", hint)
    return name
