"""``fogft simulate``: cost and availability of a pool in simulated spot markets."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fogft.cli import output
from fogft.cli.options import AsJson, Cloud, Plot
from fogft.cli.status_text import age, show_table

if TYPE_CHECKING:
    from rich.text import Text

    from fogft.simulation.comparison import Row
    from fogft.simulation.report import Report


def simulate(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The pool file.")],
    *,
    traces: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Replay the spot traces in this folder."),
    ] = None,
    prices: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Let spot prices change as recorded in this folder."),
    ] = None,
    fit: Annotated[
        bool, typer.Option("--fit", help="Generate markets that resemble the traces.")
    ] = False,
    model: Annotated[
        str,
        typer.Option(
            metavar="KEY=VALUE,...",
            help="Generate markets: mttf_s, mttr_s, correlation, boot_s, notice_s and more.",
        ),
    ] = "",
    days: Annotated[
        float, typer.Option(min=0.01, max=3650, metavar="N", help="Simulated days per market.")
    ] = 7.0,
    seeds: Annotated[
        int, typer.Option(min=1, max=10_000, metavar="N", help="Number of markets.")
    ] = 20,
    first_seed: Annotated[
        int, typer.Option(min=0, metavar="N", help="Seed of the first market.")
    ] = 0,
    cloud: Cloud = None,
    plot: Plot = None,
    as_json: AsJson = False,
) -> None:
    """Simulate a pool and fixed policies in spot markets.

    Runs the real planner, and launches nothing. The same seeds give the same results. 95 % is the
    confidence interval of AVAILABLE; UNDER TARGET, the share of time with fewer ready replicas than
    wanted; OF 1 VM and OF N VMS, the cost divided by that of one on-demand VM and of N.
    """
    from fogft.simulation.plot import check, draw
    from fogft.simulation.report import simulate as run

    if plot is not None:
        check(plot)
    with contextlib.ExitStack() as shown:
        show = None
        if output.is_terminal(sys.stderr):
            show = shown.enter_context(output.redrawn(sys.stderr))
        report = run(
            file,
            traces=traces,
            prices=prices,
            fit=fit,
            model=model,
            days=days,
            seeds=range(first_seed, first_seed + seeds),
            cloud=cloud,
            told=lambda done, of: show(f"simulated {done} of {of} runs") if show else None,
        )
    if as_json:
        output.json_data(report.to_json())
    else:
        _show(report)
    for note in report.notes:
        output.say(f"note: {note}")
    if plot is not None:
        draw(report, plot)
        output.done(f"wrote `{plot}`")


HEADER = (
    *("POLICY", "AVAILABLE", "95 %", "UNDER TARGET", "$/HOUR", "OF 1 VM", "OF N VMS"),
    *("LAUNCHES/DAY", "LOST/DAY", "LONGEST OUTAGE"),
)


def _show(report: Report) -> None:
    show_table(HEADER, [_cells(row, report) for row in report.rows], right=HEADER[1:])
    scenario = report.scenario
    kind = "recorded" if scenario.recorded else "simulated"
    output.data(
        f"\n{scenario.replicas} replicas wanted; {len(scenario.seeds)} markets ({kind}) of "
        f"{scenario.days:.4g} days. A VM is the cheapest on-demand one; N is {scenario.replicas}."
    )
    best = report.cheapest
    if not report.target:
        output.data("No replica was ever ready: `fogft plan` says what is in the way.")
    elif best is None:
        output.data(f"No policy reaches {percent(report.target)}.")
    else:
        costs = best.estimate("usd_per_hour").mean
        output.data(f"Cheapest for {percent(report.target)}: {best.name}, at ${costs:.4f}/h.")


def _cells(row: Row, report: Report) -> list[str | Text]:
    up, cost = row.estimate("available"), row.estimate("usd_per_hour")
    units = report.in_machines(row)
    return [
        output.cell(row.name, "bold" if row.name == "fogft" else ""),
        percent(up.mean),
        output.cell(f"{percent(up.low)}-{percent(up.high)}", "dim"),
        percent(row.estimate("under_target").mean),
        f"{cost.mean:.4f}",
        *([f"{unit:.3f}" for unit in units] if units else ["-", "-"]),
        f"{row.estimate('launches_per_day').mean:.1f}",
        f"{row.estimate('preemptions_per_day').mean:.1f}",
        age(row.longest_outage_s) if row.longest_outage_s else "none",
    ]


def percent(share: float) -> str:
    """Return a fraction in percent, never rounded up to 100 %."""
    for digits in (2, 3, 4, 5):
        shown = f"{100 * share:.{digits}f}"
        if share >= 1 or float(shown) < 100:
            return f"{shown} %"
    return "99.99999 %"
