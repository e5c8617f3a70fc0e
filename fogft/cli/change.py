"""``fogft scale | drain | exclude | include | retry``: change a running pool's intent."""

from __future__ import annotations

import shlex
import time
from typing import TYPE_CHECKING, Annotated

import typer

from fogft import disk
from fogft.cli import options, output, progress
from fogft.cli.commands import Command, group
from fogft.cli.options import PoolOption, Slot
from fogft.pool.commands import composition

if TYPE_CHECKING:
    from fogft.pool.folder.store import PoolStore

Count = Annotated[int, typer.Argument(min=1, max=100, metavar="N", help="Number of replicas.")]

Wait = Annotated[bool, typer.Option("--wait", help="Wait until the change is complete.")]


scale = group("Add or remove replicas.")


@scale.command("up", cls=Command, epilog="fogft scale up 1")
def scale_up(count: Count, wait: Wait = False, pool: PoolOption = None) -> None:
    """Add N replicas.

    In effect until `replicas` changes in the pool file.
    """
    _scale(pool, count, wait=wait)


@scale.command("down", cls=Command, epilog="fogft scale down 1")
def scale_down(count: Count, wait: Wait = False, pool: PoolOption = None) -> None:
    """Remove N replicas; at least one stays.

    In effect until `replicas` changes in the pool file. Replicas that are removed finish
    their requests first.
    """
    _scale(pool, -count, wait=wait)


def drain(slot: Slot, wait: Wait = False, pool: PoolOption = None) -> None:
    """Replace one replica, starting the new one first.

    The old one finishes its requests and is then ended.
    """
    from fogft.pool.commands import change
    from fogft.pool.commands.outcome import Settled

    store = composition.store_of(pool)
    since = time.time()
    generation = change.drain(store, slot, since)
    replica = f"{slot}.{generation}"
    if wait:
        progress.settle(store, Settled(since, (slot, generation)), f"has not replaced `{replica}`")
        output.done(f"replica `{replica}` of `{store.name}` is replaced")
        return
    _done(store, f"replica `{replica}` of `{store.name}` is being replaced")


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
    """Stop using a location, and move replicas out of it."""
    from fogft.pool.commands import change

    store = composition.store_of(pool)
    is_new = change.exclude(store, location, composition.cloud_of(store.identity()))
    since = "is now" if is_new else "was already"
    _done(store, f"`{location}` {since} excluded from `{store.name}`")


def include(
    location: Annotated[
        str,
        typer.Argument(
            metavar="LOCATION", autocompletion=options.excluded, help="As given to `exclude`."
        ),
    ],
    pool: PoolOption = None,
) -> None:
    """Allow an excluded location again."""
    from fogft.model import intent
    from fogft.pool.commands.change import change

    store = composition.store_of(pool)
    change(store, lambda before: intent.include(before, location))
    _done(store, f"`{location}` may be used for `{store.name}` again")


def retry(pool: PoolOption = None) -> None:
    """Launch again after fogft gave up, or reached an hour's limit."""
    from fogft.model import intent
    from fogft.pool.commands.change import change

    store = composition.store_of(pool)
    change(store, lambda before: intent.retry(before, time.time()))
    _done(store, f"`{store.name}` will launch replicas again")


def _scale(pool: str | None, by: int, *, wait: bool) -> None:
    from fogft.model import intent
    from fogft.pool.commands.change import change
    from fogft.pool.commands.outcome import Settled

    store = composition.store_of(pool)
    now = time.time()
    wishes = change(store, lambda before: intent.scale(before, store.spec(), by, now))
    since = time.time()  # earlier observations do not reflect the change
    spec = store.spec()
    before, after = (one.wanted(spec, now) for one in wishes)
    if wait:
        progress.settle(store, Settled(since), f"does not have {after} replicas")
        output.done(f"`{store.name}` has {after} replicas (had {before})")
        return
    _done(store, f"`{store.name}` is scaling from {before} to {after} replicas")


def _done(store: PoolStore, what: str) -> None:
    output.done(what)
    if not disk.is_locked(store.paths.manager_lock):
        output.warn(f"`{store.name}` has no manager: this takes effect once one is running")
        output.hint(f"start it with `fogft up {shlex.quote(store.identity().file)}`")
