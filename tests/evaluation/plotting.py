"""Pictures that several experiments draw: histograms and cumulative distributions.

Each takes an axis and values and puts exactly these on it; `drawn` reads them back.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tests.estimates import cumulative

# Told apart by all eyes (Okabe and Ito).
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9", "#666666")
# And on paper without colours: each colour goes with a line and a mark of its own.
_LINES = ("-", "--", ":", "-.", (0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)), (0, (1, 3)))
_MARKS = ("o", "s", "^", "D", "v", "x", "*")


def _told_apart(colour: str) -> dict[str, Any]:
    """Return colour, line and mark; what is none of `COLOURS` is plain."""
    if colour not in COLOURS:
        return {"color": colour, "linestyle": "-", "marker": "+"}
    number = COLOURS.index(colour)
    return {"color": colour, "linestyle": _LINES[number], "marker": _MARKS[number]}


def figure(rows: int, columns: int, **options: Any) -> tuple[Any, Any]:
    """Return an empty figure and its axes as a list of lists."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(3.6 * columns, 2.2 * rows), layout="constrained")
    axes = made.subplots(rows, columns, squeeze=False, **options)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=8)
    return made, axes


def histogram(axis: Any, values: Sequence[float], edges: Sequence[float], colour: str) -> None:
    """Count values between edges and draw a bar for each."""
    axis.hist(values, bins=edges, color=colour)


def distribution(axis: Any, values: Sequence[float], colour: str, label: str) -> None:
    """Draw the fraction of values that is not above each."""
    places, fractions = cumulative(values)
    drawn = {**_told_apart(colour), "marker": ""}
    axis.step(places, fractions, where="post", label=label, linewidth=1.3, **drawn)


def series(axis: Any, x: Sequence[float], y: Sequence[float], colour: str, label: str) -> None:
    """Draw a point for each pair."""
    axis.plot(x, y, label=label, markersize=2.5, **{**_told_apart(colour), "linestyle": ""})


def edges(samples: Sequence[Sequence[float]], count: int = 25) -> list[float]:
    """Return the edges of equal bins that hold all values of all samples."""
    high = max(max(sample) for sample in samples)
    low = min(min(sample) for sample in samples)
    width = (high - low) / count or 1.0
    return [low + width * i for i in range(count)] + [max(high, low + width * count)]


def bars(
    axis: Any, places: Sequence[float], values: Sequence[float], height: float, ours: bool
) -> None:
    """Draw horizontal bars: the paper's grey, ours in colour."""
    axis.barh(places, values, height=height, color=COLOURS[0] if ours else "#aaaaaa")


def curve(axis: Any, x: Sequence[float], y: Sequence[float], colour: str, label: str) -> None:
    """Draw a line through points, with a mark at each."""
    axis.plot(x, y, label=label, markersize=3.5, linewidth=1.2, **_told_apart(colour))
