"""Take certificates of a pool back, and have others take their place.

Owns: revoking and rotating, and waiting until it has taken effect.
Not here: bundles (`joining`), the CA and its ledger (`fogft.pool.credentials`).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial

from fogft import disk
from fogft.model import intent
from fogft.model.credentials import Holder, Role
from fogft.pool.commands import change
from fogft.pool.commands.status import slots
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import PoolStore
from fogft.pool.manager import configuration
from fogft.pool.manager.process_control import wait_for

PUBLISH_LIMIT_S = 10.0


def revoke_credentials(store: PoolStore, role: Role, name: str) -> tuple[list[Holder], bool]:
    """Revoke certificates; return their holders, and whether the pool has been told.

    A replica that is revoked is replaced, too.
    """
    store.identity()
    ledger = Ledger(store.paths.credentials)
    holders = ledger.named(role, name)
    ledger.revoke(holders)
    for holder in holders if role is Role.REPLICA else ():
        drained = partial(intent.drain, slot=int(holder.name), generation=holder.generation)
        change.change(store, drained)
    return holders, _published(store, holders)


def rotate_robot(store: PoolStore) -> tuple[Holder, list[Holder], bool]:
    """Give this machine's client proxy new credentials, and revoke the old ones once the new
    ones are in use; return the new holder, the old ones, and whether that has happened.
    """
    ledger = Ledger(store.paths.credentials)
    holder = configuration.rotate_robot(store.paths, store.identity(), store.spec())
    old = [h for h in ledger.named(Role.ROBOT, holder.name) if h != holder]
    in_use = wait_for(lambda: _in_use(store.paths, holder), PUBLISH_LIMIT_S)
    if in_use and old:
        ledger.revoke(old)
        _published(store, old)
    return holder, old, in_use


def _in_use(paths: PoolPaths, holder: Holder) -> bool:
    """Whether the client proxy reports that all its links use this certificate."""
    report = disk.read_json(paths.proxy_status)
    return isinstance(report, dict) and report.get("certificate") == holder.common_name


def rotate_replicas(store: PoolStore, slot: int | None = None) -> list[str]:
    """Have replicas replaced, the new one first, each with a key of its own; return which."""
    chosen = slots(store.paths) if slot is None else [slot]
    return [f"{one}.{change.drain(store, one, time.time())}" for one in chosen]


def _published(store: PoolStore, holders: Sequence[Holder]) -> bool:
    names = {holder.common_name for holder in holders}

    def told() -> bool:
        membership = store.membership()
        return membership is not None and names <= membership.revoked

    return told() or (disk.is_locked(store.paths.manager_lock) and wait_for(told, PUBLISH_LIMIT_S))
