"""Columns of text without lines between them, with or without colour.

Owns: aligning cells whose colour takes no room.
Not here: which columns there are (`status_text`).
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

GAP = "  "
_RESET = "\033[0m"
STYLES = {
    "": "",
    "bold": "\033[1m",
    "dim": "\033[2m",
    "good": "\033[32m",
    "soon": "\033[33m",
    "leaving": "\033[35m",
    "bad": "\033[1;31m",
    "note": "\033[1;36m",
}


@dataclass(frozen=True)
class Cell:
    """A piece of text, and the style that it has where there is colour."""

    text: str
    style: str = ""

    def painted(self, *, colour: bool, width: int = 0, right: bool = False) -> str:
        """Return the text, filled up to a width, in its colour if wanted."""
        filled = self.text.rjust(width) if right else self.text.ljust(width)
        code = STYLES[self.style]
        return f"{code}{filled}{_RESET}" if colour and code else filled


def columns(
    header: Sequence[str],
    rows: Sequence[Sequence[Cell]],
    *,
    right: Sequence[str] = (),
    colour: bool = False,
) -> list[str]:
    """Return a header line and one line for each row.

    Args:
        header: The columns' names.
        rows: As many cells each.
        right: Names of the columns that are aligned to the right.
        colour: Whether to send colour.
    """
    every = [[Cell(name, "dim") for name in header], *rows]
    widths = [max(len(row[n].text) for row in every) for n in range(len(header))]
    lines = []
    for row in every:
        cells = [
            cell.painted(colour=colour, width=width, right=name in right)
            for name, width, cell in zip(header, widths, row, strict=True)
        ]
        lines.append(GAP.join(cells).rstrip())
    return lines


def with_remark(line: str, remark: str, *, taken: int, width: int, indent: int) -> list[str]:
    """Return a line with a remark behind it, or below it where there is no room.

    Args:
        line: The line; its colours are not counted.
        remark: What to add.
        taken: How wide the line is as seen, columns filled up.
        width: How wide it may become.
        indent: Where lines below begin.
    """
    if not remark:
        return [line]
    if taken + len(GAP) + len(remark) <= width:
        return [f"{line}{GAP}{remark}"]
    room = max(20, width - indent)
    return [line.rstrip(), *(" " * indent + part for part in textwrap.wrap(remark, room))]


def milliseconds(seconds: float | None) -> str:
    """Return a short duration with three digits: ``0.42 ms``, ``12.3 ms``, ``1.20 s``."""
    if seconds is None:
        return "-"
    if seconds >= 1:
        return f"{seconds:.2f} s"
    value = seconds * 1000
    return f"{value:.{2 if value < 10 else 1 if value < 100 else 0}f} ms"
