"""``fogft sweep``: find and end machines that no manager owns."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated

import typer

from fogft.cli import output
from fogft.cli.options import Yes
from fogft.cli.status_text import age, price, show_table
from fogft.errors import FogftError

if TYPE_CHECKING:
    from fogft.pool.commands.sweep import Swept


def sweep(
    end: Annotated[
        bool, typer.Option("--end", help="End the machines found, after asking.")
    ] = False,
    yes: Yes = False,
    cloud: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Only `local` or `sky`; by default every cloud used from this machine.",
        ),
    ] = None,
) -> None:
    """Find machines that no manager owns, and optionally end them.

    Asks the clouds directly where possible. A machine whose pool is managed from another state
    folder (FOGFT_HOME) looks unowned: read the list before you end anything.
    """
    from fogft.pool.commands.sweep import clouds_used, end_found, sweep_cloud

    found = [sweep_cloud(name) for name in ([cloud] if cloud else clouds_used())]
    for one in found:
        _show(one)
    unowned = [machine for one in found for machine in one.unowned]
    if not unowned:
        blind = any(one.cloud == "sky" and not one.asked for one in found)
        known = " that SkyPilot knows" if blind else ""
        output.done(f"every machine{known} belongs to a managed pool")
        if blind:
            asked = "no cloud could be asked about machines that SkyPilot has forgotten"
            output.hint(f"{asked}; `sky check` tests the credentials")
        if cloud is None and not any(one.cloud == "sky" for one in found):
            used = "no real cloud has been used from this machine"
            output.hint(f"{used}; `--cloud sky` checks them anyway")
        return
    if not end:
        output.hint(
            "`fogft sweep --end` ends them; `fogft up FILE` restarts the manager of a "
            "pool on this machine"
        )
        return
    if not yes:
        output.confirm(f"end {len(unowned)}?")
    problems = [problem for one in found for problem in end_found(one, output.say)]
    if problems:
        hints = dict.fromkeys(problem.hint for problem in problems if problem.hint)
        raise FogftError("\n".join(problem.message for problem in problems), "; ".join(hints))
    output.done("ended all of them")


def _show(found: Swept) -> None:
    if found.cloud == "sky":
        asked = ", ".join(f"`{name}`" for name in sorted(found.asked)) or "no cloud"
        output.say(f"checked all of SkyPilot's clouds, and {asked} directly")
    now = time.time()
    rows = []
    for one in found.unowned:
        machine = one.machine
        costs, age_s = f"{price(machine.usd_per_hour)}/h", max(0.0, now - machine.launched_at)
        rows.append((str(machine.id), machine.placement.location, costs, age(age_s), one.why))
    if rows:
        names = ("MACHINE", "LOCATION", "$/H", "AGE", "WHY")
        show_table(names, rows, folds=("WHY", "LOCATION"), titled=False)
