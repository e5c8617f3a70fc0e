"""Plot a report: cost over unavailability, and serving replicas over time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from fogft.errors import FogftError
from fogft.simulation.comparison import Row
from fogft.simulation.meter import DAY_S, HOURS_A_MONTH
from fogft.simulation.report import Report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ENDINGS = (".png", ".svg", ".pdf")
_COLOURS = ("#0072b2", "#666666", "#e69f00", "#009e73", "#cc79a7")  # safe for colour-blind readers
MARKS = ("o", "s", "^", "D", "v", "P", "X", "<", "*", ">", "p")  # distinct without colour
_SHOWN_DAYS = 3.0
_STYLE: Any = {"font.size": 9, "axes.spines.right": False, "axes.spines.top": False}


def check(path: Path) -> None:
    """Check, before a long simulation, that a plot can be written to a file."""
    if path.suffix not in ENDINGS:
        known = ", ".join(f"`{ending}`" for ending in ENDINGS)
        raise FogftError(f"{path}: cannot draw a `{path.suffix}` file", f"endings: {known}")
    if not path.absolute().parent.is_dir():
        raise FogftError(f"{path}: there is no folder `{path.parent}`", "create it first")
    needs_matplotlib()


def needs_matplotlib() -> None:
    """Check that plots can be drawn at all. Raises FogftError: matplotlib is not installed."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise FogftError(
            "plots need matplotlib, which is not installed", "`pip install 'fogft[plot]'`"
        ) from None


def draw(report: Report, path: Path) -> None:
    """Plot a report to a file, in the format of its suffix."""
    check(path)
    import matplotlib
    from matplotlib.figure import Figure

    rows = report.rows
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(11, 1.9 + 0.75 * len(rows)), layout="constrained")
        left, right = cast(Any, figure.subfigures(1, 2, width_ratios=(1, 1.25)))
        _costs(left.subplots(), rows)
        drawn = [row for row in rows if row.curve]  # a bound has none
        _curves(right.subplots(len(drawn), 1, sharex=True, squeeze=False)[:, 0], report, drawn)
        right.supylabel("replicas serving", fontsize=9)
        scenario = report.scenario
        market = "recorded traces" if scenario.recorded else "a simulated market"
        figure.suptitle(
            f"{scenario.spec.name}: {report.scenario.replicas} replicas, {market}, "
            f"{len(scenario.seeds)} seeds of {scenario.days:.4g} days"
        )
        save(figure, path)


def save(figure: Figure, path: Path) -> None:
    """Write a figure to a file reproducibly."""
    import matplotlib

    metadata: dict[str, Any] = {".svg": {"Date": None}, ".png": {"Software": None}}
    try:
        with matplotlib.rc_context({"svg.hashsalt": "fogft"}):
            figure.savefig(path, dpi=150, metadata=metadata.get(path.suffix))
    except OSError as error:
        raise FogftError(f"{path}: cannot be written: {error.strerror}") from None


def _costs(axes: Any, rows: tuple[Row, ...]) -> None:
    means = [row.estimate("available").mean for row in rows]
    measured = [1 - mean for mean in means if mean < 1]
    never_down = 10 ** math.floor(math.log10(min(measured, default=1e-3)) - 1)
    for row, colour, mark in zip(rows, cycle(_COLOURS), cycle(MARKS), strict=False):
        cost, up = row.estimate("usd_per_hour"), row.estimate("available")
        x = cost.mean * HOURS_A_MONTH
        down = [max(1 - value, never_down) for value in (up.mean, up.high, up.low)]
        axes.errorbar(
            x,
            down[0],
            xerr=[[x - cost.low * HOURS_A_MONTH], [cost.high * HOURS_A_MONTH - x]],
            yerr=[[max(down[0] - down[1], 0)], [max(down[2] - down[0], 0)]],
            fmt=mark,
            color=colour,
            capsize=3,
            label=row.name + (" (never down)" if up.mean == 1 else ""),
        )
    axes.set_yscale("log")
    axes.set_ylim(top=1)
    axes.set_xlim(left=0)
    axes.set_xlabel("US dollars a month")
    axes.set_ylabel("fraction of time without any answer")
    axes.grid(True, alpha=0.3)
    axes.legend(frameon=False, fontsize=8, loc="best")


def _curves(axes: Any, report: Report, rows: Sequence[Row]) -> None:
    shown = min(_SHOWN_DAYS, report.scenario.days)
    wanted = report.scenario.replicas
    top = max((ready for row in rows for _, ready in row.curve), default=1)
    for ax, row, colour in zip(axes, rows, cycle(_COLOURS), strict=False):
        points = [(at / DAY_S, ready) for at, ready in row.curve]
        points.append((report.scenario.days, points[-1][1]))
        times, ready = zip(*points, strict=True)
        ax.step(times, ready, where="post", color=colour, linewidth=1)
        ax.fill_between(times, ready, step="post", color=colour, alpha=0.25)
        ax.axhline(wanted, color="black", linewidth=0.6, linestyle=":")
        ax.set_title(row.name, loc="left", fontsize=8, pad=2)
        ax.set_ylim(0, top + 0.3)
        ax.set_xlim(0, shown)
        ax.set_yticks(range(0, top + 1, max(1, top // 2)))
    axes[-1].set_xlabel(f"days of the first seed (dotted: the {wanted} wanted)")
