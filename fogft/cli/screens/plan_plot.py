"""Plot a plan: each offer's price over its round trip, chosen offers filled."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from fogft.simulation.plot import MARKS, save

if TYPE_CHECKING:
    from fogft.pool.commands.plan import PlanShown


def draw(shown: PlanShown, path: Path) -> None:
    """Plot a plan to a PNG, SVG or PDF file. Offers of unknown distance are drawn separately."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.8), layout="constrained")
    axes = figure.subplots()
    considered = shown.explanation.considered
    known = [one.rtt_s * 1000 for one in considered if one.rtt_s is not None]
    apart = 1.2 * max(known, default=1.0)
    for n, cloud in enumerate(sorted({one.offer.placement.cloud for one in considered})):
        offers = [one for one in considered if one.offer.placement.cloud == cloud]
        points = [
            (apart if one.rtt_s is None else one.rtt_s * 1000, one.offer.usd_per_hour)
            for one in offers
        ]
        colour, mark = f"C{n}", MARKS[n % len(MARKS)]
        axes.plot(*zip(*points, strict=True), mark, color=colour, fillstyle="none", label=cloud)
        for one, point in zip(offers, points, strict=True):
            if one.slots:
                axes.plot(*point, mark, color=colour, markersize=9)
                slots = ",".join(map(str, one.slots))
                axes.annotate(f"slot {slots}", point, (6, -3), textcoords="offset points")
    axes.set(
        title=f"{shown.spec.name}: offers considered, chosen ones filled",
        xlabel="round trip in milliseconds",
        ylabel="US dollars per hour",
    )
    axes.margins(x=0.12)
    if len(known) < len(considered):
        if known:
            axes.axvline(1.1 * apart / 1.2, color="0.7", linewidth=0.8)
        shown_at = [at for at in axes.get_xticks() if 0 <= at < 1.05 * apart / 1.2] if known else []
        axes.set_xticks([*shown_at, apart], [*(f"{at:g}" for at in shown_at), "unknown"])
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False)
    save(figure, path)
