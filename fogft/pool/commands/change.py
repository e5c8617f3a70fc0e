"""Change a running pool without changing its file: scale, drain, exclude, retry, certificates.

All but the last write the new intent under the pool's lock and return; the manager acts on it, now
or once one runs again. Changes of certificates wait until those are revoked or in use.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial

from fogft import disk
from fogft.cloud.port import Cloud
from fogft.errors import FogftError, PoolBusy
from fogft.model import intent
from fogft.model.credentials import Holder, Role
from fogft.model.groups import slots_hint
from fogft.model.intent import Intent
from fogft.pool.commands.status import read, slots
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import PoolStore
from fogft.pool.manager import configuration, offers
from fogft.pool.manager.process_control import wait_for
from fogft.poolfile.tree import nearest


def change(store: PoolStore, step: Callable[[Intent], Intent]) -> tuple[Intent, Intent]:
    """Change a pool's intent under its lock; return it before and after."""
    with disk.locked(store.paths.intent_lock):
        store.identity()  # the pool may have been shut down while we waited
        before = store.intent()
        if before.stopping:
            raise PoolBusy(
                f"pool `{store.name}` is being shut down",
                "let `fogft down` finish, then start it again with `fogft up`",
            )
        after = step(before)
        store.write_intent(after)
    return before, after


def drain(store: PoolStore, slot: int, now: float) -> int:
    """Request the replacement of the replica in a slot; return its generation."""
    generation = generation_in(store.paths, slot, now)
    change(store, lambda before: intent.drain(before, slot, generation))
    return generation


def exclude(store: PoolStore, location: str, cloud: Cloud) -> bool:
    """Exclude a location; return whether that is new."""
    identity, place = store.identity(), intent.checked_location(location)
    sold = [offer.placement for offer in offers.ask(cloud, store.spec())]
    known = {name for p in sold for name in (p.cloud, f"{p.cloud}/{p.region}", p.location)}
    if place not in known:
        meant = sorted(known & {f"{p.cloud}/{place}" for p in sold})
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
            f"the replica in slot {slot} of `{status.pool}` was started manually",
            f"end it on its own machine; `fogft credentials revoke replica {slot}` locks it out",
        )
    if not found:
        raise FogftError(
            f"pool `{status.pool}` has no replica in slot {slot}",
            slots_hint(slot, (replica.slot for replica in status.replicas)),
        )
    return max(found)


PUBLISH_LIMIT_S = 10.0


def revoke_credentials(store: PoolStore, role: Role, name: str) -> tuple[list[Holder], bool]:
    """Revoke certificates; return their holders, and whether the membership lists them.

    Revoked replicas are also replaced.
    """
    store.identity()
    holders = Ledger(store.paths.credentials).named(role, name)
    _revoke(store, holders)
    for holder in holders if role is Role.REPLICA else ():
        drained = partial(intent.drain, slot=int(holder.name), generation=holder.generation)
        change(store, drained)
    return holders, _published(store, holders)


def rotate_robot(store: PoolStore) -> tuple[Holder, list[Holder], bool]:
    """Give this machine's client proxy new credentials, and revoke the old ones once the new
    ones are in use; return the new holder, the old ones, and whether that has happened.
    """
    with disk.locked(store.paths.intent_lock):
        holder = configuration.rotate_robot(store.paths, store.identity())
    named = Ledger(store.paths.credentials).named(Role.ROBOT, holder.name)
    old = [one for one in named if one.generation < holder.generation]
    in_use = wait_for(lambda: _in_use(store.paths, holder), PUBLISH_LIMIT_S)
    if in_use and old:
        _revoke(store, old)
        _published(store, old)
    return holder, old, in_use


def _revoke(store: PoolStore, holders: Sequence[Holder]) -> None:
    with disk.locked(store.paths.intent_lock):  # no export may read the ledger meanwhile
        store.identity()
        Ledger(store.paths.credentials).revoke(holders)


def _in_use(paths: PoolPaths, holder: Holder) -> bool:
    """Whether the client proxy reports that all its links use this certificate."""
    report = disk.read_json(paths.proxy_status)
    return isinstance(report, dict) and report.get("certificate") == holder.common_name


def rotate_replicas(store: PoolStore, slot: int | None = None) -> list[str]:
    """Replace replicas, new before old, each with a new key; return their names."""
    chosen = slots(store.paths) if slot is None else [slot]
    return [f"{one}.{drain(store, one, time.time())}" for one in chosen]


def _published(store: PoolStore, holders: Sequence[Holder]) -> bool:
    names = {holder.common_name for holder in holders}

    def told() -> bool:
        membership = store.membership()
        return membership is not None and names <= membership.revoked

    return told() or (disk.is_locked(store.paths.manager_lock) and wait_for(told, PUBLISH_LIMIT_S))
