"""``fogft status | logs``: show a pool and its logs."""

from __future__ import annotations

import datetime
import json
import os
import re
import shlex
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fogft import __version__, disk
from fogft.cli import options, output, status_text
from fogft.cli.options import PoolArgument, PoolOption
from fogft.cli.status_text import age
from fogft.pool.commands import composition

if TYPE_CHECKING:
    from fogft.pool.commands.status import Seen
    from fogft.pool.folder.paths import PoolPaths

REDRAW_EVERY_S = 1.0
CHECK_LIMIT_S = 3.0  # links are probed once a second
FOLLOW_EVERY_S = 0.2


def status(  # noqa: PLR0917 - Typer reads the command line from them
    pool: PoolArgument = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON; with --watch, one object per line.")
    ] = False,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Update every second.")] = False,
    refresh: Annotated[
        bool, typer.Option("--refresh", "-r", help="Have the manager query the cloud first.")
    ] = False,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Probe each link first; exit with 1 if a request would not be answered.",
        ),
    ] = False,
    schema: Annotated[
        bool, typer.Option("--schema", help="Print the JSON Schema of --json and exit.")
    ] = False,
    named: PoolOption = None,
) -> None:
    """Show a pool: its replicas, links, and request counters.

    Unknown values are shown as `?`. FIRST counts requests that a replica answered
    first, LATE answers that came after another's, WAITING requests without an answer yet. Slots
    from 100 on stand in for spot machines, those from 2000 on were started by hand. Counters start
    at 0 with each client proxy.
    """
    if schema:
        from fogft.pool.commands.status import status_schema

        output.json_data(status_schema())
        return
    pool = options.one_pool(pool, named)
    from fogft.pool.commands.status import checked, read, renewed

    paths = composition.paths_of(pool)
    seen = renewed(paths) if refresh else read(paths, time.time())
    if check:
        seen = checked(paths, CHECK_LIMIT_S)
    if watch:
        _watch(paths, as_json=as_json)
    elif as_json:
        output.json_data(seen.to_json())
    else:
        output.show(status_text.rendered(seen, width=output.width(sys.stdout)))
    _remark(seen, paths)
    if check and not seen.answers:
        raise typer.Exit(1)


def _watch(paths: PoolPaths, *, as_json: bool) -> None:
    from fogft.pool.commands.status import read

    def looks() -> Iterator[Seen]:
        while True:
            yield read(paths, time.time())
            time.sleep(REDRAW_EVERY_S)

    if as_json:
        for seen in looks():
            output.data(json.dumps(seen.to_json()))
    width = output.width(sys.stdout)
    if not output.is_terminal(sys.stdout):
        for seen in looks():
            output.show(status_text.rendered(seen, width=width), "")
    with output.redrawn(sys.stdout) as show:
        for seen in looks():
            show(status_text.rendered(seen, width=width))


def _remark(seen: Seen, paths: PoolPaths) -> None:
    folder, up = paths.folder, f"`fogft up {shlex.quote(seen.status.file)}`"
    if seen.status.proxy_alive and not seen.links_known:
        told = "nothing" if seen.report_age_s is None else f"nothing for {age(seen.report_age_s)}"
        output.warn(f"the client proxy runs but has reported {told}: whether it answers is unknown")
        output.hint(f"it is starting, hangs or cannot write to `{folder}`; see `fogft doctor`")
    if paths.exported.exists():
        output.hint(f"exported: managed elsewhere; `fogft down {folder.name}` removes what is here")
    elif seen.status.ended and not seen.manager_alive:
        output.hint(f"restart it with {up}, or remove it with `fogft down`")
    elif not seen.manager_alive:
        goes_on = "requests continue, but lost replicas are not replaced"
        if seen.lease_left_s is not None:
            goes_on += f", and the others shut down in {age(seen.lease_left_s)}"
        output.warn(f"no manager is running: {goes_on if seen.answers else 'nothing is replaced'}")
        full = disk.unwritable(folder)
        first = f"the disk of `{folder}` is {full}: fix that, then " if full else ""
        output.hint(f"{first}start one with {up}, or shut the pool down with `fogft down`")
    elif why := disk.unwritable(folder):
        output.warn(f"the disk of `{folder}` is {why}: nothing is launched")
        output.hint(
            "the manager resumes by itself once that is fixed; requests need no disk, but while it "
            "is read-only, a pool without a rendezvous lasts only for `unmanaged_max_hours`"
        )
    elif seen.status.manager_version not in ("", __version__):
        output.warn(
            f"the pool runs fogft {seen.status.manager_version}, this command is {__version__}"
        )
        output.hint(f"{up} upgrades it while it serves")
    elif seen.age_s is not None and seen.stale:
        output.warn(f"the manager has not observed the pool for {seen.age_s:.0f} s")
        output.hint("see `fogft logs` and `fogft doctor`")


def logs(
    of: Annotated[
        str | None,
        typer.Argument(
            metavar="SLOT",
            help="Slot of a replica, or name of a pool; by default all logs.",
            autocompletion=options.slots,
        ),
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Follow new lines.")] = False,
    lines: Annotated[
        int,
        typer.Option(
            "--lines", "-n", min=0, metavar="N", help="Number of lines of each log to start with."
        ),
    ] = 50,
    pool: PoolOption = None,
) -> None:
    """Show the logs of the manager, the client proxy and the replicas.

    Each line starts with the name of its log: `manager`, `proxy` or `slot.generation`.
    """
    from fogft.pool.commands.logs import find

    slot = int(of) if of is not None and of.isdecimal() else None
    store = composition.store_of(options.one_pool(of if slot is None else None, pool))
    cloud = composition.cloud_of(store.identity())
    tails: dict[str, Tail] = {}
    begin: int | None = lines
    while True:
        for label, path in find(store, cloud, slot):
            if label not in tails:
                tails[label] = Tail(path, begin)
        for label, line in in_order({name: tail.new_lines() for name, tail in tails.items()}):
            output.data(f"{label:<8} {line}")
        if not follow:
            return
        begin = None  # a log that appears from now on is shown whole
        time.sleep(FOLLOW_EVERY_S)


_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?")
_ROS_TIME = re.compile(r"\[[A-Z]+\] \[(\d{10}\.\d+)\]")


def in_order(logs: Mapping[str, Iterable[str]]) -> list[tuple[str, str]]:
    """Merge logs into (name, line), ordered by the timestamps of their lines.

    A line without a timestamp follows the line before it; leading ones take the first timestamp.
    """
    stamped: list[tuple[str, str, str]] = []
    for name, lines in logs.items():
        timed = [(_time_of(line), line) for line in lines]
        latest = next((at for at, _ in timed if at), "")
        for at, line in timed:
            latest = at or latest
            stamped.append((latest, name, line))
    return [(name, line) for _, name, line in sorted(stamped, key=lambda entry: entry[0])]


def _time_of(line: str) -> str:
    if found := _ROS_TIME.match(line):  # a node's line
        at = datetime.datetime.fromtimestamp(float(found[1]), datetime.timezone.utc)
        return at.isoformat(timespec="milliseconds")
    found = _TIME.match(line)
    return found[0] if found else ""


class Tail:
    """A growing log, read from its `last` lines on (None: from the start). It may be missing."""

    def __init__(self, path: Path, last: int | None) -> None:
        self._path = path
        self._last = last
        self._inode = -1
        self._position = 0

    def new_lines(self) -> Iterable[str]:
        """Return the complete lines added since the last call."""
        last, self._last = self._last, None  # a log that appears later is shown whole
        return deque(self._added(), maxlen=None if last is None else min(last, sys.maxsize))

    def _added(self) -> Iterator[str]:
        try:
            file = open(self._path, "rb")  # noqa: SIM115 - closed below, in every case
        except OSError:
            return
        with file:
            stat = os.fstat(file.fileno())
            if stat.st_ino != self._inode or stat.st_size < self._position:
                self._inode, self._position = stat.st_ino, 0
            file.seek(self._position)
            for line in file:
                if line.endswith(b"\n"):
                    self._position += len(line)
                    yield line[:-1].decode(errors="replace").rstrip("\r")
