"""``fogft list | events``: all pools at a glance, and what has happened to one."""

from __future__ import annotations

import sys
import time
from collections.abc import MutableSequence, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fogft.cli import output
from fogft.cli.options import AsJson, PoolArgument, PoolOption
from fogft.errors import StateError

if TYPE_CHECKING:
    from rich.text import Text

_ANSWERS = {True: ("yes", "green"), False: ("no", "bold red"), None: ("?", "yellow")}


def list(as_json: AsJson = False) -> None:
    """List the pools on this machine: which answer, and their price."""
    from fogft.cli.status_text import age, price
    from fogft.cli.table import table
    from fogft.pool.commands import composition
    from fogft.pool.commands.status import every

    found: dict[str, dict[str, Any]] = {}
    rows: MutableSequence[Sequence[str | Text]] = []
    for name, seen in every(composition.pools(), time.time()):
        if isinstance(seen, StateError):
            found[name] = {"pool": name, "error": seen.message}
            rows.append([name, output.cell("?", "bold red"), "?", "?", "?", "?", seen.message])
            continue
        status = seen.status
        said = {key: value for key, value in seen.to_json().items() if key in _KEYS}
        found[name] = {"pool": name, **said, "error": ""}
        rows.append(
            [
                name,
                output.cell(*(("ended", "dim") if status.ended else _ANSWERS[seen.answers])),
                f"{status.ready if seen.links_known else '?'} of {status.target}",
                status.cloud,
                "?" if seen.stale else price(status.usd_per_hour).removeprefix("$"),
                "-" if seen.age_s is None else age(seen.age_s),
                status.file,
            ]
        )
    if as_json:
        output.json_data([*found.values()])
    elif rows:
        names = ("POOL", "ANSWERS", "READY", "CLOUD", "$/H", "SEEN", "FILE")
        width = output.width(sys.stdout)
        output.show(table(names, rows, width=width, right=("$/H", "SEEN"), folds=("FILE",)))
    else:
        output.say("there is no pool here")
        output.hint("start one with `fogft up FILE`")


_KEYS = frozenset(
    {"answers", "ready", "target", "cloud", "usd_per_hour", "age_s", "manager_alive"}
    | {"proxy_alive", "file", "ended"}
)


def events(
    pool: PoolArgument = None,
    count: Annotated[
        int, typer.Option("--lines", "-n", min=1, metavar="N", help="How many of the last ones.")
    ] = 50,
    as_json: AsJson = False,
    named: PoolOption = None,
) -> None:
    """Show what happened to a pool, when and why.

    Launches, losses, moves and updates, the oldest first. Of long ago only that is kept which a
    decision may still need.
    """
    from fogft.cli.table import table
    from fogft.model.plain import to_plain
    from fogft.pool.commands import composition
    from fogft.pool.manager.status import event_status

    store = composition.store_of(pool or named)
    history = store.recent(sys.maxsize)
    places = {(e.slot, e.generation): e.location for e in history if e.location}
    found = [
        replace(event_status(e), location=places.get((e.slot, e.generation), ""))
        for e in history[-count:]
    ]
    if as_json:
        output.json_data([to_plain(one) for one in found])
        return
    rows = [[_when(one.at), one.event, one.replica, one.location, one.detail] for one in found]
    names = ("TIME", "EVENT", "REPLICA", "LOCATION", "WHY")
    width = output.width(sys.stdout)
    output.show(table(names, rows, width=width, folds=("LOCATION", "WHY")))


def _when(at: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(at))
