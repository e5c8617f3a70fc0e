"""Change what a pool aims for besides its file: `scale`, `drain`, `exclude`, `include`, `retry`.

Each writes the new intent under the pool's lock and returns; the manager, now or when
there is one again, acts on it.

Owns: reading, changing and writing the intent as one step.
Not here: what the operations mean (`fogft.model.intent`).
"""

from __future__ import annotations

from collections.abc import Callable

from fogft import disk
from fogft.cloud.port import Cloud
from fogft.errors import FogftError, PoolBusy, known_slots
from fogft.model import intent
from fogft.model.intent import Intent
from fogft.pool.commands.status import read
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import PoolStore
from fogft.poolfile.tree import nearest


def change(store: PoolStore, step: Callable[[Intent], Intent]) -> tuple[Intent, Intent]:
    """Change a pool's intent under its lock; return it before and after."""
    with disk.locked(store.paths.intent_lock):
        store.identity()  # it may have been ended while we waited
        before = store.intent()
        if before.stopping:
            raise PoolBusy(
                f"pool `{store.name}` is being ended",
                "let `fogft down` finish, then start it again with `fogft up`",
            )
        after = step(before)
        store.write_intent(after)
    return before, after


def drain(store: PoolStore, slot: int, now: float) -> int:
    """Have the replica in a slot replaced; return its generation."""
    generation = generation_in(store.paths, slot, now)
    change(store, lambda before: intent.drain(before, slot, generation))
    return generation


def exclude(store: PoolStore, location: str, cloud: Cloud) -> bool:
    """Keep out of a location; return whether that is new."""
    identity, place = store.identity(), intent.checked_location(location)
    resources = store.spec().task.get("resources") or {}
    sold = [offer.placement for offer in cloud.offers(resources)]
    known = {name for p in sold for name in (p.cloud, f"{p.cloud}/{p.region}", p.location)}
    if place not in known:
        meant = [f"{cloud}/{place}" for cloud in sorted({p.cloud for p in sold})]
        meant = [name for name in meant if name in known]
        raise FogftError(
            f"the cloud `{identity.cloud}` of pool `{identity.name}` has no location `{place}`",
            f"did you mean `{meant[0]}`?" if meant else nearest(place, known),
        )
    before, after = change(store, lambda now: intent.exclude(now, place))
    return before != after


def generation_in(paths: PoolPaths, slot: int, now: float) -> int:
    """Return the highest generation of the replicas last seen in a slot."""
    status = read(paths, now).status
    found = [replica.generation for replica in status.replicas if replica.slot == slot]
    if not found and any(replica.slot == slot for replica in status.by_hand):
        raise FogftError(
            f"the replica in slot {slot} of `{status.pool}` was started by hand",
            f"end it on its own machine; `fogft credentials revoke replica {slot}` locks it out",
        )
    if not found:
        known = known_slots(replica.slot for replica in status.replicas)
        raise FogftError(
            f"pool `{status.pool}` has no replica in slot {slot}", f"slots with a replica: {known}"
        )
    return max(found)
