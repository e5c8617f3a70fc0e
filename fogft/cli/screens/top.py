"""``fogft top``: a full-screen view of one pool: status, latencies over time, events and cost."""

from __future__ import annotations

import contextlib
import sys
import time
from collections import deque
from typing import TYPE_CHECKING

from fogft.cli import options, output, status_text
from fogft.cli.options import PoolArgument, PoolOption
from fogft.pool.commands import composition

if TYPE_CHECKING:
    from rich.console import RenderableType

    from fogft.pool.commands.status import Seen
    from fogft.pool.folder.store import PoolStore

LOOK_EVERY_S = 1.0
_LOOKS_KEPT = 60
_EVENTS_SHOWN = 12
_BARS = "▁▂▃▄▅▆▇█"


def top(pool: PoolArgument = None, named: PoolOption = None) -> None:
    """Watch a pool full-screen: replicas, latencies, events and cost.

    Updates every second; Ctrl-C quits. Without a terminal, prints the screen once.
    """
    from rich.console import Console
    from rich.live import Live

    from fogft.pool.commands.status import read

    store = composition.store_of(options.one_pool(pool, named))
    latencies: dict[str, deque[float]] = {}

    def screen() -> RenderableType:
        seen = read(store.paths, time.time())
        _remember(latencies, seen)
        return _screen(seen, store, latencies, output.width(sys.stdout))

    if not output.is_terminal(sys.stdout):
        output.show(screen())
        return
    with contextlib.suppress(KeyboardInterrupt), Live(console=Console(), screen=True) as live:
        while True:
            live.update(screen(), refresh=True)
            time.sleep(LOOK_EVERY_S)


def _remember(latencies: dict[str, deque[float]], seen: Seen) -> None:
    now = {f"P99 {one.name}": one.counters.get("p99_s") for one in seen.status.services}
    now |= {f"RTT {one.slot}.{one.generation}": one.rtt_s for one in seen.status.replicas}
    for gone in latencies.keys() - now.keys():
        del latencies[gone]
    for name, value in now.items():
        if value is not None:
            latencies.setdefault(name, deque(maxlen=_LOOKS_KEPT)).append(value)


def _screen(
    seen: Seen, store: PoolStore, latencies: dict[str, deque[float]], width: int | None
) -> RenderableType:
    from rich.console import Group

    from fogft.cli.overview import EVENT_COLUMNS, event_rows
    from fogft.cli.table import table

    trends = [
        [name, sparkline(values), status_text.milliseconds(values[-1])]
        for name, values in latencies.items()
    ]
    parts: list[RenderableType] = [status_text.rendered(seen, width=width)]
    if trends:
        parts += ["", table(("LATENCY", "LAST MINUTE", "NOW"), trends, width=width, right=("NOW",))]
    events = event_rows(store, _EVENTS_SHOWN)[::-1]
    if events:
        parts += ["", table(EVENT_COLUMNS, events, width=width, folds=("LOCATION", "WHY"))]
    return Group(*parts)


def sparkline(values: deque[float]) -> str:
    """Return values as a sparkline, scaled to the largest."""
    most = max(values) or 1.0
    return "".join(_BARS[min(len(_BARS) - 1, int(len(_BARS) * one / most))] for one in values)
