"""``fogft init | up | down``: begin and end a pool."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fogft.cli import complete, output
from fogft.cli.complete import PoolArgument
from fogft.cli.sections import Command
from fogft.errors import FogftError

if TYPE_CHECKING:
    from fogft.pool.commands.preview import Preview
    from fogft.pool.commands.status import Seen

DEFAULT_FILE = Path("pool.yaml")
LIMIT_S = 300.0
REAL_LIMIT_S = 1800.0  # a VM boots, SkyPilot sets it up, then the user's `setup` runs
ROLLED_BACK = "rolled back"  # `fogft.planning.rollout.UpdateState`
HOPELESS_RESTARTS = 4  # of `run`, some eight seconds after it was first started


def register(app: typer.Typer) -> None:
    """Add these commands to the application."""
    for command in (init, up, down):
        app.command(command.__name__, cls=Command)(command)


def init(
    name: Annotated[
        str,
        typer.Argument(metavar="NAME", help="Which example.", autocompletion=complete.examples),
    ] = "",
    into: Annotated[
        Path | None,
        typer.Option(
            "--into",
            metavar="DIR",
            show_default=False,
            help="Where to; a folder with the example's name unless told.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that are there.")] = False,
) -> None:
    """Write an example to start from: a pool file with its nodes.

    \b
    Example:
      fogft init planner --into my_pool
    """
    from fogft import app

    files = app.init(name, into, force=force)
    for file in files:
        output.data(str(file))
    output.hint(f"look at `{files[0]}`, then run `fogft up {files[0]}`")


def up(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The pool file.")] = DEFAULT_FILE,
    cloud: Annotated[
        str | None,
        typer.Option(
            "--cloud",
            metavar="NAME",
            show_default=False,
            help="Where to run; what the file's resources name, else `local`.",
        ),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Do not ask. Nothing is asked on the local cloud.")
    ] = False,
    timeout: Annotated[
        float | None,
        typer.Option(
            "--timeout",
            min=1,
            metavar="S",
            show_default=False,
            help="Wait so long for the services; 300, on real clouds 1800 unless told.",
        ),
    ] = None,
) -> None:
    """Start a pool, or make a running one as its file says now.

    Returns once every service answers. Replicas that still start do so in the background. A
    changed file whose replicas have to be replaced is waited for: `up` fails where the update
    is stopped and rolled back.

    \b
    Example:
      fogft up pool.yaml
    """
    from fogft import app
    from fogft.cli import progress

    order = app.order(file, cloud, told=output.say)
    progress.announce(order.preview)
    if not yes and must_ask(order.preview) and not output.confirm(question(order.preview)):
        output.say("nothing was done")
        raise typer.Exit(1)
    limit_s = timeout or (REAL_LIMIT_S if order.preview.costs_money else LIMIT_S)
    applied_at = time.time()
    if app.start(order) and not order.preview.is_new:
        output.say("it had no manager: one was started, and takes over what runs")
    name = order.spec.name
    wanted = {service.name for service in order.spec.services}
    awaited = order.digest if order.preview.replaces_replicas or order.preview.rolled_back else ""

    def is_over(seen: Seen) -> bool:
        if awaited not in ("", seen.status.applied):
            return False
        if is_updating(seen, awaited):
            return keeps_ending(seen)
        if gave_up(seen) or is_answering(seen, wanted, applied_at):
            return True
        return keeps_ending(seen) or differs(seen)

    try:
        seen, _ = progress.wait(lambda: managed(name), is_over, limit_s)
    except KeyboardInterrupt:
        output.say(f"interrupted: `{name}` goes on starting; `fogft down {name}` ends it")
        raise typer.Exit(130) from None
    if why := gave_up(seen):
        raise FogftError(
            f"`{name}` was not updated: {why}",
            "see `fogft logs`; change the file and `fogft up` it again: this one is not retried",
        )
    if keeps_ending(seen):
        raise not_answering(seen, "does not answer: `run` ends again and again")
    if differs(seen):
        raise not_answering(seen, "cannot answer: the types are not the same on both sides")
    if not is_answering(seen, wanted, applied_at):
        raise not_answering(seen, f"does not answer after {limit_s:.0f} s")
    status = seen.status
    if not status.target:
        output.done(f"`{name}` is set up; its schedule wants no replica now")
        return
    missing = max(0, status.target - status.ready)
    rest = f"; {missing} more in preparation, see `fogft status`" if missing else ""
    if is_updating(seen, awaited):
        rest = "; the update goes on, see `fogft status`"
    for service in () if wanted else status.services:
        output.say(f"offers {service.name} ({service.type})")
    output.done(f"`{name}` answers, with {status.ready} of {status.target} replicas ready{rest}")


def must_ask(preview: Preview) -> bool:
    """Whether applying a pool file can cost more than what was agreed to before."""
    return preview.costs_money and (preview.is_new or bool(preview.changes))


def question(preview: Preview) -> str:
    """Return what is asked before money is spent."""
    count = len(preview.launches)
    if not preview.is_new or not count:
        return "go on?"
    return f"launch {count} machine{'' if count == 1 else 's'} at these prices?"


def managed(pool: str) -> Seen:
    """Return a pool's status; raise when nobody manages it any more."""
    from fogft import app
    from fogft.pool.folder.paths import PoolPaths

    seen = app.status(pool)
    if not seen.manager_alive:
        raise FogftError(
            f"the manager of `{pool}` has ended:\n{app.tail(PoolPaths.of(pool).manager_log)}",
            f"start it again with `fogft up`; `fogft down {pool}` ends what runs",
        )
    return seen


def is_answering(seen: Seen, services: set[str], since: float) -> bool:
    """Whether every service has a ready replica and a client proxy, as seen after `since`.

    Without services to look for, every one that was discovered.

    A pool whose schedule wants no replica now is as it should be.
    """
    status = seen.status
    if status.observed_at >= since and status.cloud_reachable and not status.target:
        return True
    ready = {service.name for service in status.services if service.ready_replicas}
    return (
        status.observed_at >= since
        and status.proxy_alive
        and bool(ready)
        and {service.name for service in status.services} == (services or ready) == ready
    )


def is_updating(seen: Seen, file: str) -> bool:
    """Whether an update to the file of this digest is yet to end; empty for no update."""
    if not file:
        return False
    update = seen.status.update
    return seen.status.applied != file or (update is not None and update.state != ROLLED_BACK)


def gave_up(seen: Seen) -> str:
    """Return why the file that was applied last was given up; empty where it was not."""
    return seen.status.update.fault if seen.status.update is not None else ""


def keeps_ending(seen: Seen) -> bool:
    """Whether `run` has ended so often on every replica that waiting longer is no use."""
    replicas = seen.status.replicas
    return bool(replicas) and not any(
        replica.phase == "ready" or replica.restarts < HOPELESS_RESTARTS for replica in replicas
    )


def differs(seen: Seen) -> bool:
    """Whether every replica has another definition of a service's type than this machine."""
    replicas = seen.status.replicas
    return bool(replicas) and all(replica.differs for replica in replicas)


def not_answering(seen: Seen, what: str) -> FogftError:
    """Return the error of a start that came to nothing, with all that is known of the reason."""
    from fogft import app

    status = seen.status
    silent = [service.name for service in status.services if not service.ready_replicas]
    listed = ", ".join(f"`{name}`" for name in silent) or (
        "the client proxy" if status.services else "`run`"
    )
    lines = [f"{listed} of `{status.pool}` {what}"]
    lines += [f"  {note}" for note in status.notes]
    lines += [f"  replica {r.slot}.{r.generation}: {r.detail}" for r in status.replicas if r.detail]
    logs = app.logs(status.pool)
    label, path = logs[-1] if status.proxy_alive else logs[1]
    lines += [f"the end of the log of `{label}`:"]
    lines += [f"  {line}" for line in app.tail(path).splitlines()]
    return FogftError(
        "\n".join(lines),
        "the manager goes on trying: see `fogft status` and `fogft logs`; "
        f"`fogft down {status.pool}` ends it",
    )


def down(
    pool: PoolArgument = None,
    yes: Annotated[
        bool,
        typer.Option("--yes", "-y", help="Do not ask; only a person at a terminal is asked."),
    ] = False,
) -> None:
    """End a pool: its replicas, its client proxy and its manager.

    Works when the manager is dead, and is safe to repeat.

    \b
    Example:
      fogft down
    """
    from fogft import app

    if not app.pools():
        output.say("nothing to end: there is no pool here")
        return
    name = app.pool_name(pool)
    paid = app.costs_money(name)
    asks = paid and not yes and output.is_terminal(sys.stdin)
    if asks and not output.confirm(f"end `{name}` and all its machines?"):
        output.say("nothing was done")
        raise typer.Exit(1)
    app.down(name, lambda what: output.say(f"ended {what}"), output.warn)
    output.done(f"nothing of `{name}` is left")
    if paid and not app.pools():
        output.hint("SkyPilot's own API server runs on; `sky api stop` ends one on this machine")
