"""``fogft init | up | down``: begin and end a pool."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fogft.cli import options, output
from fogft.cli.options import DEFAULT_FILE, PoolArgument, PoolFile, PoolOption
from fogft.errors import FogftError

if TYPE_CHECKING:
    from fogft.pool.commands.current import Seen


def init(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Which example.", autocompletion=options.examples)
    ] = "",
    into: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Target folder; by default one with the example's name."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False,
    schema: Annotated[
        bool, typer.Option("--schema", help="Print the JSON Schema of pool files, and stop.")
    ] = False,
) -> None:
    """Write an example pool: its pool file and its nodes."""
    from fogft.pool.commands.init import DEFAULT_EXAMPLE, copy_example

    if schema:
        import json

        from fogft.poolfile.schema import pool_schema

        output.data(json.dumps(pool_schema(), indent=2))
        return
    name = name or DEFAULT_EXAMPLE
    files = copy_example(name, into or Path(name), force=force)
    for file in files:
        output.data(str(file))
    output.hint(f"look at `{files[0]}`, then run `fogft up {files[0]}`")


def up(
    file: PoolFile = DEFAULT_FILE,
    cloud: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Where to run; by default what the file's resources name, else `local`.",
        ),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Do not ask. The local cloud never asks.")
    ] = False,
    timeout: Annotated[
        float | None,
        typer.Option(
            min=1, metavar="S", help="How long to wait for the services; 300, on real clouds 1800."
        ),
    ] = None,
) -> None:
    """Start a pool, or apply a changed pool file to a running one.

    Returns once every service answers. Replicas that still start do so in the background. A
    changed file whose replicas have to be replaced is waited for, also by an `up` that comes while
    the update is under way: it fails where the update is stopped and rolled back.
    """
    from fogft.cli import progress
    from fogft.planning.rollout import UpdateState
    from fogft.pool.commands import preview, startup, status
    from fogft.pool.commands.outcome import Awaited, Outcome
    from fogft.pool.folder.paths import PoolPaths

    order = preview.order(file, cloud, told=output.say)
    paths = PoolPaths.of(order.spec.name)
    update = None if order.preview.is_new else status.read(paths, time.time()).status.update
    under_way = update is not None and update.state != UpdateState.ROLLED_BACK.value
    progress.announce(order.preview, update if under_way else None)
    may_cost_more = order.preview.is_new or order.preview.changes
    if order.preview.costs_money and may_cost_more and not yes:
        count = len(order.preview.launches) if order.preview.is_new else 0
        machines = f"{count} machine{'' if count == 1 else 's'}"
        if not output.confirm(f"launch {machines} at these prices?" if count else "continue?"):
            output.say("nothing was done")
            raise typer.Exit(1)
    limit_s = timeout or (progress.REAL_LIMIT_S if order.preview.costs_money else progress.LIMIT_S)
    applied_at = time.time()
    if startup.start(order) and not order.preview.is_new:
        output.say("it had no manager: a new one takes over what runs")
    name = order.spec.name
    replaces = order.preview.replaces_replicas or order.preview.rolled_back or under_way
    awaited = Awaited(
        frozenset(service.name for service in order.spec.services),
        applied_at,
        order.digest if replaces else "",
    )
    try:
        seen, outcome = progress.wait(paths, awaited, limit_s)
    except KeyboardInterrupt:
        output.say(f"interrupted: `{name}` continues to start; `fogft down {name}` ends it")
        raise typer.Exit(130) from None
    if outcome is Outcome.WITHDRAWN and seen.status.update is not None:
        raise FogftError(
            f"`{name}` was not updated: {seen.status.update.fault}",
            "see `fogft logs`; change the file and `fogft up` it again: this one is not retried",
        )
    if outcome is not Outcome.ANSWERING:
        what = {
            Outcome.RUN_KEEPS_ENDING: "does not answer: `run` keeps ending",
            Outcome.NEVER_READY: "does not answer: no replica was ever ready",
            Outcome.TYPES_DIFFER: "cannot answer: robot and replicas define its type differently",
        }
        raise not_answering(seen, what.get(outcome, f"does not answer after {limit_s:.0f} s"))
    found = seen.status
    if not found.target:
        output.done(f"`{name}` is set up; its schedule asks for no replica now")
        return
    missing = max(0, found.target - found.ready)
    rest = f"; {missing} more starting, see `fogft status`" if missing else ""
    if awaited.is_updating(seen):
        rest = "; the update continues, see `fogft status`"
    for service in () if awaited.services else found.services:
        output.say(f"offers {service.name} ({service.type})")
    output.done(f"`{name}` answers, with {found.ready} of {found.target} replicas ready{rest}")


def not_answering(seen: Seen, what: str) -> FogftError:
    """Return the error of an `up` that failed, with all that is known of the reason."""
    from fogft import logfile
    from fogft.pool.commands import composition, logs
    from fogft.pool.commands.outcome import is_given_up

    status = seen.status
    silent = [service.name for service in status.services if not service.ready_replicas]
    listed = ", ".join(f"`{name}`" for name in silent) or (
        "the client proxy" if status.services else "`run`"
    )
    lines = [f"{listed} of `{status.pool}` {what}"]
    lines += [f"  {note}" for note in status.notes]
    lines += [f"  replica {r.slot}.{r.generation}: {r.detail}" for r in status.replicas if r.detail]
    store = composition.make_store(status.pool)
    found = logs.find(store, composition.cloud_of(store.identity()))
    label, path = found[-1] if status.proxy_alive else found[1]
    lines += [f"the end of the log of `{label}`:"]
    lines += [f"  {line}" for line in logfile.tail(path, lines=8).splitlines()]
    tries = "the manager keeps trying: see `fogft status` and `fogft logs`"
    if is_given_up(seen):
        tries = "change the file and `fogft up` it again, or `fogft retry`; nothing costs money now"
    return FogftError("\n".join(lines), f"{tries}; `fogft down {status.pool}` ends it")


def down(
    pool: PoolArgument = None,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Do not ask. Without a terminal, nothing is asked.")
    ] = False,
    named: PoolOption = None,
) -> None:
    """End a pool: its replicas, its client proxy and its manager.

    Works when the manager is dead, and is safe to repeat.
    """
    from fogft.pool.commands import composition
    from fogft.pool.manager import shutdown
    from fogft.ros import shared_memory

    if not composition.pools():
        output.say("nothing to end: there is no pool here")
        return
    store = composition.store_of(pool or named)
    paid = store.identity().cloud != composition.LOCAL
    asks = paid and not yes and output.is_terminal(sys.stdin)
    if asks and not output.confirm(f"end `{store.name}` and all its machines?"):
        output.say("nothing was done")
        raise typer.Exit(1)

    def told(what: str) -> None:
        output.say(f"ended {what}")

    shutdown.end(store, composition.cloud_of, told=told, warned=output.warn)
    if swept := shared_memory.sweep():  # what killed ROS processes cannot remove themselves
        told(f"{len(swept)} shared-memory files of dead processes")
    output.done(f"nothing of `{store.name}` is left")
    if paid and not composition.pools():
        output.hint("SkyPilot's own API server runs on; `sky api stop` ends one on this machine")
