"""Begin and end a pool."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fogft import disk
from fogft.app.clouds import LOCAL, cloud_names, cloud_of, make_cloud, make_store
from fogft.app.planning import far
from fogft.pool.folder.paths import home

if TYPE_CHECKING:
    from fogft.model.replica import Offer
    from fogft.model.spec import PoolSpec
    from fogft.pool.commands.preview import Order


def order(
    file: Path, cloud: str | None = None, *, told: Callable[[str], None] = lambda _: None
) -> Order:
    """Read and judge a pool file, and find out what applying it would do. Changes nothing.

    Args:
        file: The pool file.
        cloud: Where to run it; None for what its resources name, else `local`.
        told: Called with what takes long, before it is done.

    Raises:
        SpecError: The first mistake in the file.
        CloudError: There is no such cloud, or a new pool cannot use any that it names.
    """
    from fogft.cloud.port import Accounts
    from fogft.pool.commands import preview
    from fogft.poolfile import named_clouds
    from fogft.poolfile.file import parse, read_text
    from fogft.ros.comparison import check_tolerances
    from fogft.ros.state_bytes import check_state
    from fogft.ros.types import check_ok_field, check_type

    source = read_text(file)
    spec = parse(
        source,
        file=str(file),
        check_types=check_type,
        check_fields=check_ok_field,
        check_states=check_state,
        check_tolerances=check_tolerances,
        folder=file.parent,
    )
    chosen = cloud or named_clouds.cloud_of(spec, cloud_names(), source, file) or LOCAL
    concrete = make_cloud(chosen, file.resolve().parent)
    store = make_store(spec.name)
    if isinstance(concrete, Accounts):
        told("asking SkyPilot which clouds can be used, and for their prices")

    def distances(spec: PoolSpec, sold: Sequence[Offer]) -> Mapping[str, float]:
        known, _ = far(spec, sold, told=told)
        return {region: distance.rtt_s for region, distance in known.items()}

    return preview.order(
        store,
        concrete,
        spec,
        cloud_name=chosen,
        source=source,
        file=file,
        now=time.time(),
        far=distances,
    )


def start(order: Order) -> bool:
    """Create the pool or apply the changed file; return whether a manager had to be started.

    Raises:
        FogftError: The pool is another one's, is being ended, or its manager did not start.
    """
    from fogft.pool.commands import startup

    disk.make_folder(home())
    store, spec = make_store(order.spec.name), order.spec
    cloud = order.preview.cloud
    startup.write(store, spec, source=order.source, file=order.file.resolve(), cloud=cloud)
    return startup.start_manager(store)


def down(
    pool: str, told: Callable[[str], None], warned: Callable[[str], None] = lambda _: None
) -> None:
    """End a pool and all that it started; tell each thing as it has been ended.

    Args:
        pool: Its name.
        told: Called with each thing that has been ended.
        warned: Called with what could not be made certain.

    Raises:
        PoolNotFound: There is no such pool.
        FogftError: Something did not end; run it again.
    """
    from fogft.pool.manager import shutdown
    from fogft.ros import shared_memory

    shutdown.end(make_store(pool), cloud_of, told=told, warned=warned)
    swept = shared_memory.sweep()  # what killed ROS processes cannot remove themselves
    if swept:
        told(f"{len(swept)} shared-memory files of dead processes")
