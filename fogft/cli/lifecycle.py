"""``fogft init | up | down``: create, start and shut down a pool."""

from __future__ import annotations

import shlex
import signal
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fogft import __version__, logfile
from fogft.cli import options, output, progress, status_text
from fogft.cli.options import DEFAULT_FILE, Cloud, PoolArgument, PoolFile, PoolOption, Yes
from fogft.errors import FogftError
from fogft.model.topic import PREFIX
from fogft.pool.commands import composition
from fogft.pool.folder.paths import PoolPaths

if TYPE_CHECKING:
    from fogft.model.reason import Reason
    from fogft.pool.commands.status import Seen
    from fogft.pool.manager.status import PoolStatus


def init(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME", help="Name of the example.", autocompletion=options.examples
        ),
    ] = "",
    into: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Target folder; by default one with the example's name."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False,
    schema: Annotated[
        bool, typer.Option("--schema", help="Print the JSON Schema of pool files and exit.")
    ] = False,
) -> None:
    """Write an example pool: its pool file and its nodes."""
    from fogft.pool.commands.init import DEFAULT_EXAMPLE, copy_example

    if schema:
        from fogft.poolfile.schema import pool_schema

        output.json_data(pool_schema())
        return
    name = name or DEFAULT_EXAMPLE
    files = copy_example(name, into or Path(name), force=force)
    for file in files:
        output.data(str(file))
    output.hint(f"look at `{files[0]}`, then run `fogft up {shlex.quote(str(files[0]))}`")


def up(
    file: PoolFile = DEFAULT_FILE,
    cloud: Cloud = None,
    yes: Yes = False,
    timeout: Annotated[
        float | None,
        typer.Option(
            min=1,
            metavar="S",
            help="Seconds to wait for the services; by default 300, or 1800 on real clouds.",
        ),
    ] = None,
) -> None:
    """Start a pool, or apply a changed pool file to a running pool.

    Returns once every service answers; other replicas continue to start in the background. If a
    changed file replaces replicas, waits for the update, even one that is already in progress,
    and fails if it is rolled back.
    """
    from fogft.planning.rollout import UpdateState
    from fogft.pool.commands import preview, startup, status
    from fogft.pool.commands.outcome import Awaited, Outcome
    from fogft.pool.folder.store import digest

    order = preview.order(file, cloud, told=output.say)
    paths = PoolPaths.of(order.spec.name)
    running = "" if order.is_new else startup.manager_version(paths)
    upgrades = running not in ("", __version__)
    old = None if order.is_new or upgrades else status.read(paths, time.time())
    update = None if old is None else old.status.update
    under_way = update is not None and update.state != UpdateState.ROLLED_BACK.value
    progress.announce(order, update if under_way else None, upgrade_from=running)
    may_cost_more = order.is_new or order.changes or upgrades
    if order.costs_money and may_cost_more and not yes:
        count = len(order.launches) if order.is_new else 0
        machines = f"{count} machine{'' if count == 1 else 's'}"
        output.confirm(f"launch {machines} at these prices?" if count else "continue?")
    limit_s = timeout or (progress.REAL_LIMIT_S if order.costs_money else progress.LIMIT_S)
    name = order.spec.name
    try:
        if startup.start(order) and not order.is_new and not upgrades:
            output.say("the pool had no manager: started a new one")
        applied_at = time.time()  # earlier observations, or an old manager's, do not count
        replaces = order.replaces_replicas or order.rolled_back or under_way or upgrades
        awaited = Awaited(
            frozenset(service.name for service in order.spec.services),
            applied_at,
            digest(order.source.encode()) if replaces else "",
        )
        seen, outcome = progress.wait(paths, awaited, limit_s)
    except KeyboardInterrupt:
        output.say(f"interrupted: `{name}` continues to start; `fogft down {name}` shuts it down")
        raise typer.Exit(130) from None
    if outcome is Outcome.WITHDRAWN:
        raise _not_updated(seen.status)
    if outcome is not Outcome.ANSWERING:
        what = {
            Outcome.RUN_KEEPS_ENDING: "does not answer: `run` keeps exiting",
            Outcome.NEVER_READY: "does not answer: no replica has become ready",
            Outcome.TYPES_DIFFER: "cannot answer: robot and replicas disagree on its type",
        }
        hint = ""
        if outcome is Outcome.RUN_KEEPS_ENDING and not order.spec.task.get("workdir"):
            hint = "add `workdir: .` if `run` needs files from the pool file's folder; "
        raise _not_answering(seen, what.get(outcome, f"does not answer after {limit_s:g} s"), hint)
    found = seen.status
    if not found.target:
        output.done(f"`{name}` is set up; its schedule asks for no replicas now")
        return
    missing = found.target - found.ready
    rest = f"; {missing} more starting, see `fogft status`" if missing > 0 else ""
    if awaited.is_updating(seen):
        rest = "; the update continues, see `fogft status`"
    for service in () if awaited.services else found.services:
        output.say(f"offers {service.name} ({service.type})")
    for trouble in status_text.troubles(found):
        output.warn(trouble)
    output.done(f"`{name}` answers, with {found.ready} of {found.target} replicas ready{rest}")


def services_at_fault(status: PoolStatus) -> list[str]:
    """Return the services that do not answer; if types differ, only those that differ."""
    differing = {n for one in status.replicas for n in one.differing if not n.startswith(PREFIX)}
    return sorted(differing) or [one.name for one in status.services if not one.answers]


def _not_updated(status: PoolStatus) -> FogftError:
    why = "" if status.update is None else status.update.fault
    lines = [f"`{status.pool}` was not updated: {why}"]
    if replica := _replica_at_fault(status.reasons):
        lines += _end_of_log(status, replica)
    hint = "see `fogft logs`; then change this file, if only a comment, and run `fogft up`"
    return FogftError("\n".join(lines), hint)


def _replica_at_fault(reasons: Iterable[Reason]) -> str:
    """Return the replica whose failure stopped an update; empty if there is none."""
    from fogft.model.reason import Cause

    for reason in reasons:
        if reason.cause is Cause.REPLICA_FAILS:
            return reason.replica
        if found := _replica_at_fault(reason.because):
            return found
    return ""


def _end_of_log(status: PoolStatus, of: str = "") -> list[str]:
    """Return the last lines of a replica's log; by default the last replica's or the proxy's."""
    from fogft.pool.commands import logs

    store = composition.make_store(status.pool)
    found = logs.find(store, composition.cloud_of(store.identity()))
    last = found[-1] if status.proxy_alive else found[1]
    label, path = next((one for one in found if one[0] == of), last)
    last_lines = logfile.tail(path, lines=8).splitlines()
    return [f"the end of the log of `{label}`:", *(f"  {line}" for line in last_lines)]


def _not_answering(seen: Seen, what: str, hint: str) -> FogftError:
    from fogft.pool.commands.outcome import is_given_up

    status = seen.status
    listed = ", ".join(f"`{name}`" for name in services_at_fault(status)) or (
        "the client proxy" if status.services else "`run`"
    )
    lines = [f"{listed} of `{status.pool}` {what}"]
    lines += [f"  {note}" for note in status.notes]
    lines += [f"  replica {r.slot}.{r.generation}: {r.detail}" for r in status.replicas if r.detail]
    lines += _end_of_log(status)
    tries = "the manager keeps trying: see `fogft status` and `fogft logs`"
    if is_given_up(seen):
        tries = "change the file and run `fogft up` again, or `fogft retry`; nothing is running now"
    return FogftError("\n".join(lines), f"{hint}{tries}; `fogft down {status.pool}` ends it")


def down(pool: PoolArgument = None, yes: Yes = False, named: PoolOption = None) -> None:
    """Shut down a pool: its replicas, client proxy and manager.

    Works even if the manager is dead, and is safe to repeat. For an exported pool, stops only
    what this machine still runs.
    """
    from fogft.pool.manager import shutdown
    from fogft.ros import shared_memory

    name = options.one_pool(pool, named)
    if not composition.pools() and not composition.pools(exported=True):
        output.say("no pools on this machine")
        return
    store = composition.store_of(name)
    elsewhere = store.paths.exported.exists()
    paid = not elsewhere and store.identity().cloud != composition.LOCAL
    if paid and not yes and output.is_terminal(sys.stdin):
        output.confirm(f"shut down `{store.name}` and all its machines?")

    def told(what: str) -> None:
        output.say(f"ended {what}")

    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # half a `down` leaves machines without a manager
    try:
        shutdown.end(store, composition.cloud_of, told=told, warned=output.warn)
    except KeyboardInterrupt:
        output.say(f"interrupted: `fogft down {store.name}` does the rest")
        raise typer.Exit(130) from None
    if swept := shared_memory.sweep():  # killed ROS processes leave them behind
        told(f"{len(swept)} shared-memory files of dead processes")
    if elsewhere:
        output.done(f"`{store.name}` is removed here; another machine manages it")
        return
    output.done(f"`{store.name}` is shut down; nothing is left")
    if paid and not composition.pools():
        output.hint("SkyPilot's API server is still running; `sky api stop` ends it")
