"""``fogft doctor``: what is wrong here, and what to do about each finding."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fogft.cli import output
from fogft.cli.sections import Command

if TYPE_CHECKING:
    from fogft.doctor.finding import Finding

_STYLES = {"ok": "\033[32m", "warn": "\033[1;33m", "fail": "\033[1;31m"}
_NAME_WIDTH = 18


def register(app: typer.Typer) -> None:
    """Add this command to the application."""
    app.command("doctor", cls=Command)(doctor)


def doctor(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="A pool file to check as well.", show_default=False),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list instead.")] = False,
) -> None:
    """Check this machine, ROS 2 and the pools on it; say what to do.

    Each finding comes with its remedy. Changes nothing. Exit status 1 when something does not work.

    \b
    Example:
      fogft doctor pool.yaml
    """
    from fogft import app

    found: list[Finding] = []
    for finding in app.doctor(file):
        found.append(finding)
        if not as_json:
            output.data(text(finding, colour=output.coloured(sys.stdout)))
    if as_json:
        output.json_data([as_dict(finding) for finding in found])
    failed = sum(f.verdict.value == "fail" for f in found)
    warned = sum(f.verdict.value == "warn" for f in found)
    output.say(f"\n{len(found)} checks: {failed} failed, {warned} to look at")
    if failed:
        raise typer.Exit(1)


def text(finding: Finding, *, colour: bool = False) -> str:
    """Return a finding as one line, and its advice as another."""
    verdict = finding.verdict.value.ljust(4)
    if colour:
        verdict = f"{_STYLES[finding.verdict.value]}{verdict}\033[0m"
    line = f"{verdict}  {finding.check.ljust(_NAME_WIDTH)}  {finding.text}"
    if not finding.advice:
        return line
    return f"{line}\n{' ' * (_NAME_WIDTH + 8)}-> {finding.advice}"


def as_dict(finding: Finding) -> dict[str, str]:
    """Return a finding as it stands in the JSON list."""
    return {
        "check": finding.check,
        "verdict": finding.verdict.value,
        "text": finding.text,
        "advice": finding.advice,
    }
