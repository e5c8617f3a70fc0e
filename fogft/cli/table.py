"""Tables that fit the terminal: text wraps between words, then columns move below.

Numbers and words are never cut. Only an `optional` column without values is left out.
"""

import re
from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

from rich.cells import cell_len
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from fogft.cli.output import cell

_GAP = 2
_LEAST = 18  # width of a folded column, unless a word is longer
_PIECE = re.compile(r"[^ /]*[ /]?")
_EMPTY = frozenset({"", "-", "0"})


class _Column(NamedTuple):
    name: str
    cells: list[Text]
    natural: int  # its width unfolded
    least: int  # the width that it needs


def table(
    header: Iterable[str],
    rows: Iterable[Iterable[str | Text]],
    *,
    width: int | None = None,
    right: Collection[str] = (),
    folds: Collection[str] = (),
    optional: Collection[str] = (),
    titled: bool = True,
) -> RenderableType:
    """Return a table without rules, split into several that repeat the first column if needed.

    Columns in `folds` may wrap; with `width`, `optional` ones that are empty or all 0 are left out.
    """
    cells = [[cell(one) if isinstance(one, str) else one for one in row] for row in rows]
    columns = [
        _column(name if titled else "", [row[at] for row in cells], name in folds)
        for at, name in enumerate(header)
    ]
    if width is not None:
        columns = [
            one
            for one in columns
            if one.name not in optional or not {text.plain for text in one.cells} <= _EMPTY
        ]
    parts = [columns] if width is None else _parts(columns, width)
    drawn: list[RenderableType] = []
    for part in parts:
        rows_shown = [
            row
            for row in zip(*(one.cells for one in part), strict=True)
            if part is parts[0] or any(one.plain for one in row[1:])
        ]
        drawn += ["", _drawn(part, rows_shown, right, titled)]
    return Group(*drawn[1:])


def _column(name: str, cells: list[Text], folds: bool) -> _Column:
    lines = [line for one in cells for line in one.plain.split("\n")]
    natural = max(map(cell_len, (name, *lines)))
    if not folds:
        return _Column(name, cells, natural, natural)
    pieces = (piece for one in cells for piece in _PIECE.findall(one.plain))
    least = max(_LEAST, cell_len(name), *map(cell_len, pieces))
    return _Column(name, cells, natural, min(natural, least))


def _parts(columns: list[_Column], width: int) -> list[list[_Column]]:
    """Split the columns into as many tables as are needed, with their text wrapped to fit."""
    first, *rest = columns
    parts: list[list[_Column]] = []
    while rest or not parts:
        part = [first]
        while rest and (len(part) == 1 or _needed([*part, rest[0]]) <= width):
            part.append(rest.pop(0))
        spare = width - _needed(part)
        for at, one in enumerate(part):
            room = one.least + max(0, spare)
            spare -= min(one.natural, room) - one.least
            if one.natural > room:
                part[at] = one._replace(cells=[_folded(text, room) for text in one.cells])
        parts.append(part)
    return parts


def _needed(columns: list[_Column]) -> int:
    return sum(one.least for one in columns) + _GAP * (len(columns) - 1)


def _folded(text: Text, width: int) -> Text:
    lines = [""]
    for piece in _PIECE.findall(text.plain):
        if lines[-1] and cell_len((lines[-1] + piece).rstrip()) > width:
            lines.append("")
        lines[-1] += piece
    return Text("\n".join(line.rstrip() for line in lines), text.style)


def _drawn(
    columns: list[_Column], rows: Iterable[Sequence[Text]], right: Collection[str], titled: bool
) -> Table:
    made = Table(
        box=None, pad_edge=False, padding=(0, _GAP, 0, 0), header_style="dim", show_header=titled
    )
    for one in columns:
        made.add_column(one.name, justify="right" if one.name in right else "left", no_wrap=True)
    for row in rows:
        made.add_row(*row)
    return made
