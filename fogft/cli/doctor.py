"""``fogft doctor``: find problems on this machine and say how to fix them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fogft.cli import output
from fogft.cli.options import AsJson

if TYPE_CHECKING:
    from fogft.doctor.finding import Finding

_STYLES = {"ok": "green", "warn": "bold yellow", "fail": "bold red"}


def doctor(
    file: Annotated[
        Path | None, typer.Argument(metavar="FILE", help="A pool file to check as well.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check this machine, ROS 2 and the pools, and suggest fixes.

    Each finding comes with its remedy. Changes nothing. Exits with 1 if a check fails.
    """
    from fogft.doctor import checks
    from fogft.doctor.finding import Verdict

    found: list[Finding] = []
    for finding in checks.examine(file):
        found.append(finding)
        if not as_json:
            _show(finding)
    if as_json:
        output.json_data([finding._asdict() for finding in found])
    failed = sum(f.verdict is Verdict.FAIL for f in found)
    warned = sum(f.verdict is Verdict.WARN for f in found)
    output.say(
        f"\n{len(found)} checks: {failed} failed, {warned} warning{'' if warned == 1 else 's'}"
    )
    if failed:
        raise typer.Exit(1)


def _show(finding: Finding) -> None:
    from rich.text import Text

    verdict = finding.verdict.value
    text = output.indented(output.printable(finding.text), 26)
    parts = (f"{verdict:<4}", _STYLES[verdict]), f"  {finding.check:<18}  {text}"
    output.show(Text.assemble(*parts), folds=False)  # wrapped already, between whole paths
    if finding.advice:
        output.data(f"{'':<26}-> {output.indented(finding.advice, 29)}")
