"""Show what ``fogft up`` will do, then each replica as it starts. All of it goes to stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from fogft import __version__, disk, logfile
from fogft.cli import output, status_text
from fogft.errors import FogftError
from fogft.pool.commands import composition

if TYPE_CHECKING:
    from fogft.model.spec import PoolSpec
    from fogft.pool.commands.outcome import Awaited, Outcome, Settled
    from fogft.pool.commands.preview import Preview
    from fogft.pool.commands.status import Seen
    from fogft.pool.folder.paths import PoolPaths
    from fogft.pool.folder.store import PoolStore
    from fogft.pool.manager.status import UpdateStatus

LOOK_EVERY_S = 0.2
MANAGER_GONE_S = 3.0  # a manager restarted by another version's `up` or the proxy is back
LIMIT_S = 300.0
REAL_LIMIT_S = 1800.0  # a VM boots, SkyPilot sets it up, then the user's `setup` runs


def announce(
    preview: Preview, joined: UpdateStatus | None = None, *, upgrade_from: str = ""
) -> None:
    """Print what `up` is about to do; `joined` is an update to this same file, in progress.

    `upgrade_from` is the fogft version of the pool's running manager; empty if there is none.
    """
    spec = preview.spec
    for name, problem in preview.accounts.items():
        output.say(f"`{name}` " + (f"cannot be used: {problem}" if problem else "can be used"))
    if preview.is_new:
        count = preview.wanted or spec.replicas
        replicas = f"{count} replica{'' if count == 1 else 's'}"
        output.say(f"pool `{spec.name}`: {replicas} on `{preview.cloud}`")
        _show_launches(preview)
    elif preview.changes:
        output.say(f"pool `{spec.name}` changes:")
        for change in preview.changes:
            output.say(f"  {change}")
        if preview.replaces_replicas:
            order = "new before old" if preview.new_before_old else "old before new"
            output.say(f"  replicas are replaced one at a time, {order}")
            if not preview.new_before_old:
                output.say(f"  {_no_room(spec)}")
        if preview.costs_money and preview.launches:
            output.say(f"  at current prices the pool costs ${preview.usd_per_hour:.3f}/h")
    elif joined is not None:
        done = f"{joined.done} of {joined.of} replicas run it"
        output.say(f"pool `{spec.name}` is already being updated to this file: {done}; waiting")
    elif not preview.rolled_back and upgrade_from in ("", __version__):
        output.say(f"pool `{spec.name}` already matches its file")
        if isinstance(spec.task.get("workdir"), str):
            output.say("  files in `workdir` are not compared: to deploy them, change `envs` too")
    if upgrade_from not in ("", __version__):
        output.say(
            f"pool `{spec.name}` runs fogft {upgrade_from}: upgrading its manager, client proxy "
            f"and replicas to {__version__}, one at a time"
        )
    for note in preview.notes:
        output.warn(note)


def _no_room(spec: PoolSpec) -> str:
    if spec.max_surge == 0:
        why = "`max_surge` is 0"
    else:
        why = f"${spec.max_usd_per_hour:g}/h (`max_usd_per_hour`) leaves no room for both"
    if spec.replicas == 1:
        return f"{why}, and the only replica is never ended first, so it is not updated"
    return f"{why}: one fewer replica serves in the meantime"


def _show_launches(preview: Preview) -> None:
    from fogft.cli.plan_text import price_source
    from fogft.cli.table import table
    from fogft.model.groups import GATEWAY_SLOT

    rows = [
        (
            f"  {'gateway' if launch.slot == GATEWAY_SLOT else launch.slot}",
            launch.offer.placement.location,
            launch.offer.placement.instance,
            f"${launch.offer.usd_per_hour:.3f}/h",
            price_source(launch.offer, preview.observed_at),
        )
        for launch in preview.launches
    ]
    if rows:
        output.show(table([""] * 5, rows, titled=False), stream=sys.stderr)
        output.say(f"  total ${preview.usd_per_hour:.3f}/h")


def wait(paths: PoolPaths, awaited: Awaited | Settled, timeout_s: float) -> tuple[Seen, Outcome]:
    """Show a pool's progress until `up` has an outcome; return the last status and the outcome."""
    from fogft.pool.commands import status
    from fogft.pool.commands.outcome import Outcome

    managed_at = time.monotonic()
    deadline, ahead_s = managed_at + timeout_s, time.time() - managed_at
    with _shown() as show:
        while True:
            before_s, ahead_s = ahead_s, time.time() - time.monotonic()
            if ahead_s < before_s:  # the clock was set back: observations follow it
                awaited = replace(awaited, since=awaited.since + ahead_s - before_s)
            seen = status.read(paths, time.time())
            if seen.manager_alive:
                managed_at = time.monotonic()
            elif time.monotonic() - managed_at >= MANAGER_GONE_S:
                name, log = paths.folder.name, logfile.tail(paths.manager_log, lines=8)
                if full := disk.unwritable(paths.folder):  # its log lacks that
                    log = f"{log}\nthe disk of `{paths.folder}` is {full}".strip()
                raise FogftError(
                    f"the manager of `{name}` has exited:\n{log}",
                    f"restart it with `fogft up`; `fogft down {name}` shuts the pool down",
                )
            show(seen)
            outcome = awaited.outcome(seen)
            if outcome is not Outcome.PENDING:
                return seen, outcome
            if time.monotonic() >= deadline:
                return seen, awaited.outcome(seen, is_last=True)
            time.sleep(LOOK_EVERY_S)


def settle(store: PoolStore, settled: Settled, what: str) -> None:
    """Show a pool's progress until a change is complete."""
    from fogft.pool.commands.outcome import Outcome

    is_local = store.identity().cloud == composition.LOCAL
    limit_s = LIMIT_S if is_local else REAL_LIMIT_S
    seen, outcome = wait(store.paths, settled, limit_s)
    if outcome is not Outcome.ANSWERING:
        found = f"{seen.status.ready} of {seen.status.target} replicas are ready"
        notes = "".join(f"\n  {note}" for note in seen.status.notes)
        raise FogftError(
            f"`{store.name}` {what} after {limit_s:.0f} s: {found}{notes}",
            "the manager continues: see `fogft status` and `fogft logs`",
        )


@contextmanager
def _shown() -> Iterator[Callable[[Seen], None]]:
    if not output.is_terminal(sys.stderr):
        yield _phase_lines()
        return
    width = output.width(sys.stderr)
    with output.redrawn(sys.stderr) as show:
        yield lambda seen: show(status_text.starting(seen.status, width=width))


def _phase_lines() -> Callable[[Seen], None]:
    """Return a function that prints each change of a replica's phase and each new note."""
    known: dict[str, tuple[str, str]] = {}
    notes: set[str] = set()

    def say(seen: Seen) -> None:
        replicas = {f"{r.slot}.{r.generation}": r for r in seen.status.replicas}
        for name, replica in replicas.items():
            phase, detail = known.get(name, ("", ""))
            known[name] = (replica.phase, replica.detail)
            if phase != replica.phase:
                where = "" if phase else f" at {replica.location}"
                output.say(f"{name}  {replica.phase}{where}")
            if replica.detail not in ("", detail):
                output.say(f"{name}  {replica.detail}")
        for name in [name for name in known if name not in replicas]:
            del known[name]
            output.say(f"{name}  gone")
        for note in seen.status.notes:
            if note not in notes:
                notes.add(note)
                output.say(f"note: {note}")

    return say
