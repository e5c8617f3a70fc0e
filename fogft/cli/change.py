"""``fogft scale | drain | exclude | include``: ask a running pool for something else.

Each records the wish on disk and returns; the manager acts on it within a tick, and
still does after it was killed.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated

import typer

from fogft import disk
from fogft.cli import options, output
from fogft.cli.commands import Command, group
from fogft.cli.options import PoolOption, Slot

if TYPE_CHECKING:
    from fogft.pool.folder.store import PoolStore

Count = Annotated[int, typer.Argument(min=1, max=16, metavar="N", help="How many.")]


scale = group("Ask for more or fewer replicas.")


@scale.command("up", cls=Command)
def scale_up(count: Count, pool: PoolOption = None) -> None:
    """Ask for N more replicas.

    This stays until the pool file's own `replicas` changes.

    \b
    Example:
      fogft scale up 1
    """
    _scale(pool, count)


@scale.command("down", cls=Command)
def scale_down(count: Count, pool: PoolOption = None) -> None:
    """Ask for N fewer replicas; at least one stays.

    This stays until the pool file's own `replicas` changes. Replicas that go finish
    what they work on first.

    \b
    Example:
      fogft scale down 1
    """
    _scale(pool, -count)


def drain(slot: Slot, pool: PoolOption = None) -> None:
    """Replace one replica, the new one first.

    The old one finishes what it works on, and goes.

    \b
    Example:
      fogft drain 2
    """
    from fogft.pool.commands import composition, wishes

    store = composition.store_of(pool)
    replica = wishes.drain(store, slot, time.time())
    output.done(f"replica `{replica}` of `{store.name}` is to be replaced")
    _remark_on_manager(store)


def exclude(
    location: Annotated[
        str,
        typer.Argument(
            metavar="LOCATION",
            autocompletion=options.locations,
            help="`cloud`, `cloud/region` or `cloud/region/zone`.",
        ),
    ],
    pool: PoolOption = None,
) -> None:
    """Launch nothing in a location, and move away what runs there.

    \b
    Example:
      fogft exclude local/us-west-2
    """
    from fogft.pool.commands import composition, wishes

    store = composition.store_of(pool)
    is_new = wishes.exclude(store, location, composition.cloud_of(store.identity()))
    since = "is now" if is_new else "was already"
    output.done(f"`{location}` {since} excluded from `{store.name}`")
    _remark_on_manager(store)


def include(
    location: Annotated[
        str,
        typer.Argument(
            metavar="LOCATION",
            autocompletion=options.excluded,
            help="As it was given to `exclude`.",
        ),
    ],
    pool: PoolOption = None,
) -> None:
    """Allow a location again that was excluded.

    \b
    Example:
      fogft include local/us-west-2
    """
    from fogft.pool.commands import composition, wishes

    store = composition.store_of(pool)
    wishes.include(store, location)
    output.done(f"`{location}` may be used by `{store.name}` again")
    _remark_on_manager(store)


def _scale(pool: str | None, by: int) -> None:
    from fogft.pool.commands import composition, wishes

    store = composition.store_of(pool)
    before, after = wishes.scale(store, by)
    output.done(f"`{store.name}` shall have {after} replicas (was {before})")
    _remark_on_manager(store)


def _remark_on_manager(store: PoolStore) -> None:
    if not disk.is_locked(store.paths.manager_lock):
        output.warn(f"no manager of `{store.name}` runs: this happens once one does")
        output.hint(f"start it with `fogft up {store.identity().file}`")
