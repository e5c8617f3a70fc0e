"""Make things go wrong on the local cloud."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fogft.app.clouds import cloud_of, local_root, make_store
from fogft.errors import FogftError, known_slots

if TYPE_CHECKING:
    from fogft.cloud.local.chaos import Chaos
    from fogft.model.replica import ReplicaId


def chaos() -> Chaos:
    """Return what makes things go wrong on the local cloud."""
    from fogft.cloud.local.chaos import Chaos

    return Chaos(local_root())


def machine_in(pool: str, slot: int) -> ReplicaId:
    """Return the newest machine that the cloud lists in a slot of a pool, to act upon.

    Raises:
        FogftError: There is none (the hint lists those there are).
    """
    identity = make_store(pool).identity()
    machines = cloud_of(identity).machines(identity.uid)
    found = [machine.id for machine in machines if machine.id.slot == slot]
    if not found:
        known = known_slots(machine.id.slot for machine in machines)
        raise FogftError(f"no machine runs in slot {slot} of `{pool}`", f"slots with one: {known}")
    return max(found)
