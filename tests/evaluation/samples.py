"""Raw samples: one CSV file a condition, appended a row at a time, whole or not at all.

Owns: the files' form, and what is left of them after an interruption.
Not here: which trials are run (`running`), what is made of the rows (`statistics`, `figures`).
"""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from tests.evaluation.errors import EvaluationError
from tests.evaluation.experiment import Row, Value

COMMON = ("trial", "began_at", "load")


class Samples(Mapping[str, list[Row]]):
    """The rows of an experiment by condition, in the order of their trials."""

    def __init__(self, rows: Mapping[str, Sequence[Row]]) -> None:
        self._rows = {c: sorted(r, key=lambda row: row["trial"]) for c, r in rows.items()}

    def __getitem__(self, condition: str) -> list[Row]:
        return self._rows[condition]

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def column(self, condition: str, field: str, **where: Value) -> list[float]:
        """Return one column of a condition as numbers: of the rows that are as `where` says.

        Empty cells are left out: they stand for what was not measured in that trial.
        """
        return [
            float(row[field])
            for row in self._rows[condition]
            if row[field] != "" and all(row[k] == v for k, v in where.items())
        ]


class Store:
    """The files of one experiment below a results folder.

    Args:
        folder: Of the experiment; made where it is missing.
        fields: Columns beside the common ones.
    """

    def __init__(self, folder: Path, fields: Sequence[str]) -> None:
        self.folder = folder
        self._head = [*COMMON, *fields]

    def file(self, condition: str) -> Path:
        """Return where a condition's rows lie."""
        if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", condition):
            raise ValueError(f"a condition is lower-case letters, digits, dashes: {condition!r}")
        return self.folder / f"{condition}.csv"

    def append(self, condition: str, row: Row) -> None:
        """Put a row at the end of its file, with one write.

        Raises:
            ValueError: The row has other columns.
        """
        if set(row) != set(self._head):
            odd = sorted(set(row) ^ set(self._head))
            raise ValueError(f"{condition}: missing or unknown columns: {odd}")
        path = self.file(condition)
        self.folder.mkdir(parents=True, exist_ok=True)
        text = "" if path.exists() and path.stat().st_size else _line(self._head)
        text += _line([_cell(row[name]) for name in self._head])
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        try:
            data = text.encode()
            if os.write(descriptor, data) != len(data):
                raise EvaluationError(f"{path}: the disk is full; make room and run this again")
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def read(self, condition: str) -> list[Row]:
        """Return a condition's rows; none where there is no file.

        A last line without its end, which an interruption left, is cut off the file.

        Raises:
            EvaluationError: The file is of another version of the experiment, or damaged.
        """
        path = self.file(condition)
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            return []
        whole = data[: data.rfind(b"\n") + 1]
        if whole != data:
            os.truncate(path, len(whole))
        if not whole:
            return []
        try:
            head, *lines = list(csv.reader(io.StringIO(whole.decode()), strict=True))
            if head != self._head:
                raise ValueError(f"its columns are {head}")
            rows = [
                {k: _value(v) for k, v in zip(head, line, strict=True)} for line in lines if line
            ]
        except (ValueError, csv.Error) as error:
            raise EvaluationError(f"{path}: not a file of this experiment ({error})") from None
        return rows

    def clear(self) -> None:
        """Remove all rows."""
        for path in self.folder.glob("*.csv"):
            path.unlink()

    def samples(self, conditions: Sequence[str]) -> Samples:
        """Return the rows of these conditions."""
        return Samples({condition: self.read(condition) for condition in conditions})


def _line(cells: Sequence[str]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerow(cells)
    return out.getvalue()


def _cell(value: Value) -> str:
    """Write a value so that reading it gives the same one back."""
    if isinstance(value, bool):
        return str(int(value))
    return repr(value) if isinstance(value, float) else str(value)


def _value(cell: str) -> Value:
    for kind in (int, float):
        try:
            return kind(cell)
        except ValueError:
            continue
    return cell
