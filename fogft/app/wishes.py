"""What a running pool shall become."""

from __future__ import annotations

import time

from fogft.app.clouds import cloud_of, make_store
from fogft.errors import FogftError


def scale(pool: str, by: int) -> tuple[int, int]:
    """Want `by` more replicas (fewer when negative); return how many before and after."""
    from fogft.pool.commands import wishes

    return wishes.scale(make_store(pool), by)


def drain(pool: str, slot: int) -> str:
    """Have the replica in a slot replaced; return it as ``slot.generation``."""
    from fogft.pool.commands import wishes

    return wishes.drain(make_store(pool), slot, time.time())


def exclude(pool: str, location: str) -> bool:
    """Keep out of a location; return whether that is new.

    Raises:
        FogftError: The pool's cloud has no such location.
    """
    from fogft.model.intent import checked_location
    from fogft.pool.commands import wishes
    from fogft.poolfile.tree import nearest

    store = make_store(pool)
    identity, place = store.identity(), checked_location(location)
    resources = store.spec().task.get("resources") or {}
    sold = [offer.placement for offer in cloud_of(identity).offers(resources)]
    known = {name for p in sold for name in (p.cloud, f"{p.cloud}/{p.region}", p.location)}
    if place not in known:
        meant = [f"{cloud}/{place}" for cloud in sorted({p.cloud for p in sold})]
        meant = [name for name in meant if name in known]
        raise FogftError(
            f"the cloud `{identity.cloud}` of pool `{pool}` has no location `{place}`",
            f"did you mean `{meant[0]}`?" if meant else nearest(place, known),
        )
    return wishes.exclude(store, place)


def include(pool: str, location: str) -> None:
    """Allow a location again."""
    from fogft.pool.commands import wishes

    wishes.include(make_store(pool), location)
