"""The logs of a pool: manager, client proxy, and one for each launch.

Owns: finding them.
Not here: reading and following them (`fogft.cli.status`).
"""

import contextlib
import sys
from pathlib import Path

from fogft.cloud.port import Cloud
from fogft.errors import CloudError, FogftError
from fogft.model.groups import slots_hint
from fogft.model.replica import ReplicaId
from fogft.planning.observed.history import OF_NO_REPLICA
from fogft.pool.folder.store import PoolStore

EVENTS = 200


def find(store: PoolStore, cloud: Cloud, slot: int | None = None) -> list[tuple[str, Path]]:
    """Return logs by name: ``manager``, ``proxy``, ``slot.generation``; or one slot's replicas'."""
    uid = store.identity().uid
    events = [e for e in store.recent(sys.maxsize) if e.kind not in OF_NO_REPLICA]
    launched = {(e.slot, e.generation) for e in events[-EVENTS:]}
    with contextlib.suppress(CloudError):
        launched |= {(m.id.slot, m.id.generation) for m in cloud.machines(uid)}
    found = []
    if slot is None:
        found = [("manager", store.paths.manager_log), ("proxy", store.paths.proxy_log)]
    for where, generation in sorted(launched):
        id = ReplicaId(uid, where, generation)
        path = cloud.log(id) if slot in (None, where) else None
        if path is not None:
            found.append((id.short, Path(path)))
    if slot is not None and not found:
        raise FogftError(
            f"there is no log of a replica in slot {slot} of `{store.paths.folder.name}`",
            slots_hint(slot, (one for one, _ in launched)),
        )
    return found
