"""End every machine of a pool, verified with the clouds themselves.

Owns: ending machines in parallel until none is listed, the final check without any cache, and the
message if it is not known what still runs.
Not here: ending one machine (`fogft.cloud`).
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from fogft.cloud.port import Auditing, Cloud
from fogft.errors import CloudError, CloudUnreachable, FogftError, StateError
from fogft.model.replica import Machine, ReplicaId
from fogft.pool.folder.store import PoolStore

ASK_AGAIN_S = 1.0


@dataclass(frozen=True)
class Known:
    """The machines recorded in a pool's folder, in case its cloud does not answer.

    `running` describes those not known to have ended; `clouds` are all clouds with a launch.
    """

    pool: str
    running: tuple[str, ...] = ()
    clouds: frozenset[str] = frozenset()
    unmanaged_max_hours: float | None = None


def known(store: PoolStore) -> Known:
    """Return the machines recorded in a pool's folder. Never fails."""
    pool = store.paths.folder.name
    try:
        history = store.history()
        running = tuple(
            f"replica {r.slot}.{r.generation} ({r.location})"
            for r in sorted(history.open(), key=lambda r: (r.slot, r.generation))
        )
        clouds = frozenset(place.split("/")[0] for place in history.locations if place)
        return Known(pool, running, clouds, store.spec().unmanaged_max_hours)
    except FogftError:
        return Known(pool)


def end_machines(
    cloud: Cloud,
    uid: str,
    *,
    known: Known,
    done: Callable[[str], None],
    warned: Callable[[str], None],
    limit_s: float,
) -> None:
    """End all machines that carry a pool's uid; return when none is left.

    Raises:
        CloudUnreachable: It is not known what is left; the message lists what may be left.
        FogftError: Some machines did not end within `limit_s`; the message says which, and why.
    """
    deadline = time.monotonic() + limit_s
    told: set[str] = set()
    refusals: dict[ReplicaId, FogftError] | None = None
    while True:
        try:
            left = _left(cloud, uid, known, warned)
        except CloudUnreachable as error:
            raise _unknown(error, known) from error
        if not left:
            return
        if refusals is not None:
            if time.monotonic() > deadline:
                still = CloudError("it is still listed")
                raise _stubborn({m: refusals.get(m.id, still) for m in left}, known)
            time.sleep(ASK_AGAIN_S if refusals else 0.0)
        refusals = _end(cloud, left)
        for machine in left:
            short = machine.id.short
            if machine.id not in refusals and short not in told:
                told.add(short)
                done(f"replica {short} ({machine.placement.location})")


def _left(cloud: Cloud, uid: str, known: Known, warned: Callable[[str], None]) -> Sequence[Machine]:
    """Return the machines listed; if there are none, those in the clouds' own lists."""
    left = [m for m in cloud.machines(uid) if m.id.pool_uid == uid]
    if left or not isinstance(cloud, Auditing):
        return left
    audit = cloud.audit(uid)
    left = [m for m in audit.machines if m.id.pool_uid == uid]
    if not left:
        for name in sorted(known.clouds - audit.asked):
            warned(
                f"`{name}` could not be queried: only SkyPilot says that nothing is left there; "
                f"search its console for machines with the label `fogft-pool={uid}`"
            )
    return left


def _end(cloud: Cloud, machines: Sequence[Machine]) -> dict[ReplicaId, FogftError]:
    """End machines in parallel; return those that did not end, with their errors."""

    def terminate(machine: Machine) -> FogftError | None:
        try:
            cloud.terminate(machine.id)
        except (CloudError, StateError) as refused:
            return refused
        return None

    try:
        with ThreadPoolExecutor(max_workers=8) as threads:
            errors = list(threads.map(terminate, machines))
    except RuntimeError:  # no thread can be started
        errors = list(map(terminate, machines))
    return {m.id: error for m, error in zip(machines, errors, strict=True) if error is not None}


def _stubborn(refusals: dict[Machine, FogftError], known: Known) -> FogftError:
    names = ", ".join(f"`{m.id.short}` ({m.placement.location})" for m in refusals)
    why = "; ".join(sorted({error.message for error in refusals.values()}))
    hints = sorted({error.hint for error in refusals.values() if error.hint})
    return FogftError(
        f"these replicas did not end: {names}: {why}",
        "; ".join([f"run `fogft down {known.pool}` again", *hints]),
    )


def _unknown(error: CloudUnreachable, known: Known) -> CloudUnreachable:
    lines = [f"cannot tell what is left of `{known.pool}`: {error.message}"]
    lines += [f"  may still be running: {replica}" for replica in known.running]
    hints = [f"run `fogft down {known.pool}` again", *([error.hint] if error.hint else [])]
    if known.unmanaged_max_hours is not None:
        hours = f"{known.unmanaged_max_hours:g} hours"
        hints.append(f"replicas that hear from no manager shut down after {hours}")
    return CloudUnreachable("\n".join(lines), "; ".join(hints))
