"""``fogft report``: an HTML page of a pool's availability, latencies, events and cost by day."""

from __future__ import annotations

import html
import io
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fogft.cli import options, output
from fogft.cli.options import PoolArgument, PoolOption
from fogft.cli.status_text import age, milliseconds, price
from fogft.errors import FogftError
from fogft.model.plain import utc
from fogft.pool.commands import composition
from fogft.pool.folder.paths import home

if TYPE_CHECKING:
    from fogft.planning.observed.history import Event

_EVENTS_SHOWN = 500
_UNITS = (("days", 86400.0), ("hours", 3600.0), ("minutes", 60.0))
_STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; } td, th { text-align: left; padding: .2rem .8rem .2rem 0; }
th { border-bottom: 1px solid; } td { vertical-align: top; } svg { max-width: 100%; height: auto; }
td:not(:last-child) { white-space: nowrap; }
@media (prefers-color-scheme: dark) { svg { filter: invert(1) hue-rotate(180deg); } }
"""


def report(
    pool: PoolArgument = None,
    into: Annotated[
        Path | None,
        typer.Option("--into", metavar="FILE", help="File to write; by default POOL.html."),
    ] = None,
    named: PoolOption = None,
) -> None:
    """Write an HTML page about a pool: availability, latency, cost.

    Based on the manager's history, which keeps old events only while a decision needs them.
    """
    from fogft.simulation.plot import needs_matplotlib

    needs_matplotlib()
    store = composition.store_of(options.one_pool(pool, named))
    path = into or Path(f"{store.name}.html")
    try:
        path.write_text(_page(store, time.time()), encoding="utf-8")
    except OSError as error:
        raise FogftError(f"`{path}` cannot be written: {error.strerror}") from error
    output.done(f"wrote `{path}`")


def _page(store: Any, now: float) -> str:
    from fogft.cli.overview import event_rows
    from fogft.pool.commands.status import read
    from fogft.pool.folder.costs import read_all

    seen = read(store.paths, now)
    status = seen.status
    events = list(store.recent(sys.maxsize))
    last = max((event.at for event in events), default=0.0)
    now = min(now, max(last, status.observed_at or now))  # nothing is known of later times
    spans = list(ready_spans(events, now))
    known_s = now - min((at for _, at, _ in spans), default=now)
    costs = [one for one in read_all(home() / "costs") if one.uid == status.uid]
    days: dict[str, float] = {}
    for spent in (row for one in costs for row in one.spent):
        days[spent.day] = days.get(spent.day, 0.0) + spent.usd
    parts = [
        f"<h1>Pool {html.escape(status.pool)}</h1>",
        f"<p>{status.ready} of {status.target} replicas ready on {html.escape(status.cloud)}; "
        f"{price(sum(one.usd for one in costs))} spent; written {utc(now)}.</p>",
        "<h2>Availability</h2>",
        f"<p>At least one replica was ready for {_covered_s(spans) / known_s:.4%} of the last "
        f"{age(known_s)}, for which events are kept.</p>"
        if known_s
        else "<p>No replica has been ready yet.</p>",
        _figure(lambda axes: _draw_spans(axes, spans, now), 0.6 + 0.3 * len(spans))
        if spans
        else "",
        "<h2>Latency by replica</h2>",
        _table(
            ("replica", "location", "round trip", "first responses", "phase"),
            (
                (f"{r.slot}.{r.generation}", r.location, milliseconds(r.rtt_s), str(r.won), r.phase)
                for r in status.replicas
            ),
        ),
        "<h2>Latency by service</h2>",
        _table(
            ("service", "requests", "median", "99th percentile"),
            (
                (
                    one.name,
                    str(one.counters.get("received", 0)),
                    milliseconds(one.counters.get("p50_s")),
                    milliseconds(one.counters.get("p99_s")),
                )
                for one in status.services
            ),
        ),
        "<h2>Cost by day</h2>",
        _figure(lambda axes: _draw_costs(axes, days), 2.4)
        if days
        else "<p>Nothing has been spent.</p>",
        "<h2>Events</h2>",
        _table(
            ("time", "event", "replica", "location", "why"),
            reversed(event_rows(store, _EVENTS_SHOWN)),
        ),
    ]
    return (
        '<!doctype html>\n<html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Pool {html.escape(status.pool)}</title><style>{_STYLE}</style>"
        f"<body>\n{chr(10).join(parts)}\n</body></html>\n"
    )


def ready_spans(events: Iterable[Event], now: float) -> Iterator[tuple[str, float, float]]:
    """Yield each period in which a replica was ready: ``slot.generation``, start, end."""
    from fogft.planning.observed.history import EventKind

    over = (EventKind.UNREADY, EventKind.ENDED, EventKind.GONE)
    since: dict[str, float] = {}
    for event in events:
        replica = f"{event.slot}.{event.generation}"
        if event.kind is EventKind.READY:
            since.setdefault(replica, event.at)
        elif replica in since and event.kind in over:
            yield replica, since.pop(replica), event.at
    for replica, at in since.items():
        yield replica, at, now


def _covered_s(spans: Sequence[tuple[str, float, float]]) -> float:
    covered_s = latest = 0.0
    for _, at, until in sorted(spans, key=lambda span: span[1]):
        covered_s += max(0.0, until - max(at, latest))
        latest = max(latest, until)
    return covered_s


def _draw_spans(axes: Any, spans: Sequence[tuple[str, float, float]], now: float) -> None:
    names = sorted({name for name, _, _ in spans}, key=lambda name: [*map(int, name.split("."))])
    longest_s = now - min(at for _, at, _ in spans)
    unit, unit_s = next((row for row in _UNITS if longest_s >= 2 * row[1]), _UNITS[-1])
    for name, at, until in spans:
        row = names.index(name)
        axes.hlines(row, (at - now) / unit_s, (until - now) / unit_s, color="k", linewidth=6)
    axes.set_yticks(range(len(names)), names)
    axes.set(xlabel=f"{unit} before this page was written", title="ready replicas")


def _draw_costs(axes: Any, days: dict[str, float]) -> None:
    axes.bar(list(days), list(days.values()), color="0.4", edgecolor="k")
    axes.set(ylabel="US dollars", title="cost by day (UTC)")
    axes.tick_params(axis="x", rotation=30)


def _figure(draw: Any, inches: float) -> str:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, max(1.6, inches)), layout="constrained")
    draw(figure.subplots())
    drawn = io.StringIO()
    figure.savefig(drawn, format="svg", transparent=True)
    return drawn.getvalue()[drawn.getvalue().index("<svg") :]


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    def cells(kind: str, row: Sequence[str]) -> str:
        return "".join(f"<{kind}>{html.escape(output.printable(one))}</{kind}>" for one in row)

    body = "".join(f"<tr>{cells('td', row)}</tr>\n" for row in rows)
    return f'<div class="wide"><table><tr>{cells("th", header)}</tr>\n{body}</table></div>'
