"""The composition root: the only place that picks concrete adapters for the ports.

One function for each thing that the command line can ask. They take and return values and
never print; imports stand inside them so that a command loads only what it needs.

Owns: which cloud, which reader of pool files, which store; what a command means.
Not here: text (`fogft.cli`), decisions (`fogft.core`), the parts themselves.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fogft import disk
from fogft.core.errors import CloudError, FogftError
from fogft.pool.paths import PoolPaths, home

if TYPE_CHECKING:
    from fogft.cloud.local.chaos import Chaos
    from fogft.cloud.port import Cloud
    from fogft.core.model import ReplicaId
    from fogft.doctor.finding import Finding
    from fogft.pool.preview import Order
    from fogft.pool.seen import Seen
    from fogft.pool.store import PoolStore

CLOUDS = ("local",)


# --- Pools and their files


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

    return LocalCloud(_local_root())


def make_store(pool: str) -> PoolStore:
    """Return the store of a pool."""
    from fogft.pool import pool_file
    from fogft.pool.store import PoolStore

    return PoolStore(
        PoolPaths.of(pool),
        lambda text, file: pool_file.parse(text, file=file),
        time.time,
    )


# --- Begin and end


def order(file: Path, cloud: str | None = None) -> Order:
    """Read and judge a pool file, and find out what applying it would do. Changes nothing.

    Args:
        file: The pool file.
        cloud: Where to run it; None for what its resources name, else `local`.

    Raises:
        SpecError: The first mistake in the file.
        CloudError: Its cloud is not supported.
    """
    from fogft.pool import pool_file, preview
    from fogft.ros.types import check_ok_field, check_service_type

    source = pool_file.text(file)
    spec = pool_file.parse(
        source,
        file=str(file),
        check_types=check_service_type,
        check_fields=check_ok_field,
        folder=file.parent,
    )
    chosen = cloud or preview.cloud_of(spec, CLOUDS, source, file) or CLOUDS[0]
    concrete = make_cloud(chosen)
    store = make_store(spec.name)
    return preview.order(store, concrete, spec, cloud_name=chosen, source=source, file=file)


def start(order: Order) -> bool:
    """Create the pool or apply the changed file; return whether a manager had to be started.

    Raises:
        FogftError: The pool is another one's, is being ended, or its manager did not start.
    """
    from fogft.pool import startup

    disk.make_folder(home())
    store, spec = make_store(order.spec.name), order.spec
    cloud = order.preview.cloud
    startup.write(store, spec, source=order.source, file=order.file.resolve(), cloud=cloud)
    return startup.start_manager(store)


def down(pool: str, told: Callable[[str], None]) -> None:
    """End a pool and all that it started; tell each thing as it has been ended.

    Raises:
        PoolNotFound: There is no such pool.
        FogftError: Something did not end; run it again.
    """
    from fogft.pool import shutdown
    from fogft.ros import shared_memory

    shutdown.end(make_store(pool), make_cloud, told=told)
    swept = shared_memory.sweep()  # what killed ROS processes cannot remove themselves
    if swept:
        told(f"{len(swept)} shared-memory files of dead processes")


# --- What a running pool shall become


def scale(pool: str, by: int) -> tuple[int, int]:
    """Want `by` more replicas (fewer when negative); return how many before and after."""
    from fogft.pool import wishes

    return wishes.scale(make_store(pool), by)


def drain(pool: str, slot: int) -> str:
    """Have the replica in a slot replaced; return it as ``slot.generation``."""
    from fogft.pool import wishes

    return wishes.drain(make_store(pool), slot, time.time())


def exclude(pool: str, location: str) -> bool:
    """Keep out of a location; return whether that is new.

    Raises:
        FogftError: The pool's cloud has no such location.
    """
    from fogft.core.intent import checked_location
    from fogft.core.spec_tree import nearest
    from fogft.pool import wishes

    store = make_store(pool)
    cloud, place = store.identity().cloud, checked_location(location)
    zones = {offer.placement.location for offer in make_cloud(cloud).offers({})}
    known = {cloud, *zones, *(zone.rsplit("/", 1)[0] for zone in zones)}
    if place not in known:
        in_cloud = f"{cloud}/{place}"
        raise FogftError(
            f"the cloud `{cloud}` of pool `{pool}` has no location `{place}`",
            f"did you mean `{in_cloud}`?" if in_cloud in known else nearest(place, known),
        )
    return wishes.exclude(store, place)


def include(pool: str, location: str) -> None:
    """Allow a location again."""
    from fogft.pool import wishes

    wishes.include(make_store(pool), location)


# --- Looking


def manager_alive(pool: str) -> bool:
    """Whether a manager of this pool runs."""
    return disk.is_locked(PoolPaths.of(pool).manager_lock)


def file_of(pool: str) -> str:
    """Return the pool file that a pool was started from."""
    from fogft.pool.store import read_identity

    return read_identity(PoolPaths.of(pool)).file


def status(pool: str) -> Seen:
    """Return what the manager last saw of a pool, how old it is, and who looks now."""
    from fogft.pool import seen

    return seen.read(PoolPaths.of(pool), time.time())


def refresh(pool: str, limit_s: float = 15.0) -> Seen:
    """Have the manager look again; without one, ask the cloud and the client proxy's report.

    Raises:
        StateError: The manager did not look again within `limit_s`.
    """
    from fogft.pool import seen

    if manager_alive(pool):
        return seen.renewed(PoolPaths.of(pool), limit_s)
    store = make_store(pool)
    return seen.ask(store, make_cloud(store.identity().cloud), time.time())


def slots(pool: str) -> list[int]:
    """Return the slots that hold a replica, sorted."""
    return sorted({replica.slot for replica in status(pool).status.replicas})


def locations(pool: str) -> list[str]:
    """Return where the replicas are: regions and zones, sorted."""
    zones = {replica.location for replica in status(pool).status.replicas}
    return sorted(zones | {zone.rsplit("/", 1)[0] for zone in zones})


def excluded(pool: str) -> list[str]:
    """Return the locations that are excluded now, sorted."""
    return sorted(make_store(pool).intent().excluded)


def logs(pool: str, slot: int | None = None) -> list[tuple[str, Path]]:
    """Return a pool's logs, each with its name: ``manager``, ``proxy``, ``slot.generation``."""
    from fogft.pool import logs

    store = make_store(pool)
    return logs.find(store, make_cloud(store.identity().cloud), slot)


def tail(path: Path, lines: int = 8) -> str:
    """Return the last lines of a log; empty where there is none."""
    from fogft.pool import process_control

    return process_control.log_tail(path, lines)


def doctor(file: Path | None = None) -> Iterator[Finding]:
    """Check this machine, ROS 2, a pool file and the pools here; yield findings as they come."""
    from fogft.doctor import checks, finding
    from fogft.pool import pool_file

    spec = None if file is None else pool_file.read(file)
    yield from finding.run(checks.ALL, finding.situation(home(), pools(), spec))


# --- Chaos on the local cloud


def chaos() -> Chaos:
    """Return what makes things go wrong on the local cloud."""
    from fogft.cloud.local.chaos import Chaos

    return Chaos(_local_root())


def machine_in(pool: str, slot: int) -> ReplicaId:
    """Return the newest machine that the cloud lists in a slot of a pool, to act upon.

    Raises:
        FogftError: There is none (the hint lists those there are).
    """
    identity = make_store(pool).identity()
    machines = make_cloud(identity.cloud).machines(identity.uid)
    found = [machine.id for machine in machines if machine.id.slot == slot]
    if not found:
        known = ", ".join(sorted({str(machine.id.slot) for machine in machines})) or "none"
        raise FogftError(f"no machine runs in slot {slot} of `{pool}`", f"slots with one: {known}")
    return max(found)


def _local_root() -> Path:
    return home() / "local"


# --- Examples and parts


def init(example: str, into: Path | None, *, force: bool = False) -> list[Path]:
    """Write an example's files; return them, the pool file first.

    Args:
        example: Its name; empty for the default one.
        into: The folder; None for one with the example's name, here.
        force: Overwrite files that are there.

    Raises:
        FogftError: There is no such example, or a file is in the way.
    """
    from fogft.pool import init as examples_

    name = example or examples_.DEFAULT_EXAMPLE
    return examples_.copy_example(name, into or Path(name), force=force)


def examples() -> Sequence[str]:
    """Return the names of the examples that `init` can write."""
    from fogft.pool import init

    return list(init.examples())


def run_proxy(config: Path) -> None:
    """Run a client proxy until a signal ends it."""
    from fogft.proxy import client_process

    client_process.run(config)


def run_server(
    config: Path,
    *,
    listen: str | None = None,
    domain_id: int | None = None,
    workdir: Path | None = None,
    notice_file: Path | None = None,
) -> None:
    """Run a server proxy until a signal ends it."""
    from fogft.proxy import server_process

    server_process.run(
        config, listen=listen, domain_id=domain_id, workdir=workdir, notice_file=notice_file
    )


def run_manager(pool: str) -> None:
    """Run a pool's manager until a signal ends it, or the pool has been ended."""
    from fogft.pool import manager

    manager.run(make_store(pool), make_cloud)
