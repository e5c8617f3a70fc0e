"""``fogft list | events | cost``: all pools at a glance, a pool's history, and what it has cost."""

from __future__ import annotations

import sys
import time
from collections.abc import MutableSequence, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fogft.cli import options, output
from fogft.cli.options import AsJson, PoolArgument, PoolOption
from fogft.cli.status_text import age, price, readiness, show_table
from fogft.errors import PoolBusy, PoolNotFound, StateError
from fogft.model.plain import to_plain
from fogft.pool.commands import composition
from fogft.pool.folder.paths import PoolPaths, home

if TYPE_CHECKING:
    from rich.text import Text

    from fogft.pool.folder.costs import Costs
    from fogft.pool.folder.store import PoolStore
    from fogft.pool.manager.status import EventStatus

_LISTED = (
    *("answers", "ready", "target", "cloud", "usd_per_hour", "age_s", "manager_alive"),
    *("proxy_alive", "file", "ended"),
)
EVENT_COLUMNS = ("TIME", "EVENT", "REPLICA", "LOCATION", "WHY")
_ANSWERS = {True: ("yes", "green"), False: ("no", "bold red"), None: ("?", "yellow")}


def list(as_json: AsJson = False) -> None:
    """List the pools on this machine."""
    from fogft.pool.commands.status import read

    found: dict[str, dict[str, Any]] = {}
    rows: MutableSequence[Sequence[str | Text]] = []
    exported = composition.pools(exported=True)
    for name in sorted({*composition.pools(), *exported}):
        try:
            seen = read(PoolPaths.of(name), time.time())
        except PoolNotFound:  # it has just been ended
            continue
        except (PoolBusy, StateError) as error:
            found[name] = {"pool": name, "error": error.message}
            rows.append([name, output.cell("?", "bold red"), "?", "?", "?", "?", error.message])
            continue
        status = seen.status
        said = {key: value for key, value in seen.to_json().items() if key in _LISTED}
        found[name] = {"pool": name, **said, "exported": name in exported, "error": ""}
        left = "exported" if name in exported else "ended" if status.ended else ""
        rows.append(
            [
                name,
                output.cell(*((left, "dim") if left else _ANSWERS[seen.answers])),
                readiness(seen).removesuffix(" ready"),
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
        show_table(names, rows, right=("$/H", "SEEN"), folds=("FILE",))
    else:
        output.say("no pools on this machine")
        output.hint("start one with `fogft up FILE`")


def events(
    pool: PoolArgument = None,
    count: Annotated[
        int, typer.Option("--lines", "-n", min=1, metavar="N", help="Number of events.")
    ] = 50,
    as_json: AsJson = False,
    named: PoolOption = None,
) -> None:
    """Show the history of a pool.

    Launches, losses, moves and updates, oldest first. Old events are dropped once no decision
    needs them.
    """
    store = composition.store_of(options.one_pool(pool, named))
    if as_json:
        output.json_data([to_plain(one) for one in _last_events(store, count)])
        return
    show_table(EVENT_COLUMNS, event_rows(store, count), folds=("LOCATION", "WHY"))


def event_rows(store: PoolStore, count: int) -> Sequence[Sequence[str]]:
    """Return the last events as rows of a table, the oldest first."""
    return [
        [
            time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(one.at)),
            *(one.event, one.replica, one.location, one.detail),
        ]
        for one in _last_events(store, count)
    ]


def _last_events(store: PoolStore, count: int) -> Sequence[EventStatus]:
    from fogft.pool.manager.status import event_status

    history = store.recent(sys.maxsize)
    places = {(e.slot, e.generation): e.location for e in history if e.location}
    return [
        replace(event_status(e), location=places.get((e.slot, e.generation), ""))
        for e in history[-count:]
    ]


def cost(pool: PoolArgument = None, as_json: AsJson = False, named: PoolOption = None) -> None:
    """Show what a pool has cost so far, by day (UTC) and replica.

    Charges each interval at its own price: machines, and on real clouds their disks, addresses
    and the egress of the file's `traffic`. Without a name, shows all pools, including those that
    have ended.
    """
    from fogft.pool.folder.costs import read_all

    name = options.one_pool(pool, named)
    found = [one for one in read_all(home() / "costs") if name in (None, one.pool)]
    if name is not None and not found:
        raise PoolNotFound(
            f"no costs are recorded for a pool `{name}`", "`fogft cost` lists every pool with costs"
        )
    if as_json:
        output.json_data([_costs_json(one) for one in found])
    elif not found:
        output.say("nothing has been spent from this machine")
    else:
        _show_costs(found)


def _costs_json(costs: Costs) -> dict[str, Any]:
    days: dict[str, MutableSequence[dict[str, Any]]] = {}
    for one in costs.spent:
        row = {key: value for key, value in vars(one).items() if key != "day"}
        days.setdefault(one.day, []).append(row)
    return {
        "pool": costs.pool,
        "uid": costs.uid,
        "usd": costs.usd,
        "earlier_usd": costs.before_usd,
        "days": [
            {"day": day, "usd": sum(row["usd"] for row in rows), "replicas": rows}
            for day, rows in days.items()
        ],
    }


def _show_costs(found: Sequence[Costs]) -> None:
    rows: MutableSequence[Sequence[str]] = []
    for costs in found:
        if costs.before_usd:
            before = price(costs.before_usd).removeprefix("$")
            rows.append([costs.pool, "earlier", "", "", "", "", before])
        rows.extend(
            [
                *(costs.pool, one.day, one.replica, one.location),
                f"{one.instance}{' spot' if one.spot else ''}",
                f"{one.hours:.2f}",
                price(one.usd).removeprefix("$"),
            ]
            for one in costs.spent
        )
    names = ("POOL", "DAY", "REPLICA", "LOCATION", "INSTANCE", "HOURS", "$")
    show_table(names, rows, right=("HOURS", "$"), folds=("LOCATION",))
    output.data("")
    for costs in found:
        output.data(f"{costs.pool}: {price(costs.usd)}")
