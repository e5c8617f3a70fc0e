"""Pictures of `picking`: the timeline of latencies by winner, and the arm at moments of it."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from tests.bench.rig import ROOT
from tests.evaluation import plotting
from tests.evaluation.experiment import Row

FRAMES = 10
_LINE_POINTS = 11  # a short phase and the next have their words above one another


def draw(rows: Sequence[Row], phases: Mapping[str, str]) -> Mapping[str, Any]:
    """Return the timeline and the strip of frames."""
    return {"timeline": timeline(rows, phases), "frames": frames(rows, phases)}


def timeline(rows: Sequence[Row], phases: Mapping[str, str]) -> Any:
    """Draw a point for each request, in the colour of who answered first."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    figure = Figure(figsize=(10, 3.2), layout="constrained")
    axis = figure.subplots()
    axis.spines[["top", "right"]].set_visible(False)
    for slot, colour in ((0, plotting.COLOURS[0]), (1, plotting.COLOURS[1])):
        won = [row for row in rows if str(row["winner"]) == str(slot)]
        x, y = ([float(row[k]) for row in won] for k in ("at_s", "latency_s"))
        plotting.series(axis, x, y, colour, f"#{slot + 1} answered first")
    for number, (phase, word) in enumerate(phases.items()):
        at = [float(row["at_s"]) for row in rows if row["phase"] == phase]
        if at:
            axis.axvline(at[0], color="#999999", linewidth=0.7)
            axis.annotate(f" {phase}: {word}", (at[0], 1.0), xycoords=axis.get_xaxis_transform(),
                          xytext=(0, 2 + _LINE_POINTS * (number % 2)), fontsize=8,
                          textcoords="offset points")  # fmt: skip
    axis.set_yscale("log")
    axis.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    for ticks in (axis.yaxis.set_major_formatter, axis.yaxis.set_minor_formatter):
        ticks("{x:g}")
    axis.set_xlabel("seconds", fontsize=8)
    axis.set_ylabel("latency, s", fontsize=8)
    axis.legend(fontsize=7, loc="upper right")
    return figure


def frames(rows: Sequence[Row], phases: Mapping[str, str]) -> Any:
    """Draw the cell as it was at moments that are equally far apart."""
    from matplotlib.figure import Figure

    chosen = [rows[round(i * (len(rows) - 1) / (FRAMES - 1))] for i in range(FRAMES)]
    figure = Figure(figsize=(12, 4.2), layout="constrained")
    axes = figure.subplots(2, FRAMES // 2)
    for axis, row, picture in zip(axes.flat, chosen, pictures(chosen), strict=True):
        axis.imshow(picture)
        axis.set_axis_off()
        what = f"{row['at_s']} s, {row['phase']}: {phases[str(row['phase'])]}, cycle {row['cycle']}"
        axis.set_title(what, fontsize=7)
    return figure


def pictures(rows: Sequence[Row]) -> list[Any]:
    """Return what the cell looked like, drawn from the states in the rows."""
    folder = str(ROOT / "templates" / "pick")
    sys.path.insert(0, folder)
    try:
        cell = importlib.import_module("cell").Cell()
    finally:
        sys.path.remove(folder)
    drawn = []
    for row in rows:
        cell.show(str(row["state"]))
        drawn.append(cell.overview().copy())
    cell.close()
    return drawn
