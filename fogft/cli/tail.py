"""Follow log files: its last lines, then whatever is added, also after it was replaced."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

_CHUNK_BYTES = 1 << 16
_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?")


def in_order(logs: Mapping[str, Iterable[str]]) -> list[tuple[str, str]]:
    """Merge logs into (name, line) by the times at the beginnings of lines.

    A line without a time, such as a service's own, stays behind the one before it.
    """
    stamped: list[tuple[str, str, str]] = []
    for name, lines in logs.items():
        latest = ""
        for line in lines:
            found = _TIME.match(line)
            latest = found[0] if found else latest
            stamped.append((latest, name, line))
    return [(name, line) for _, name, line in sorted(stamped, key=lambda entry: entry[0])]


class Tail:
    """One file that grows, from its `last` lines on (None: from the first). It may be missing."""

    def __init__(self, path: Path, last: int | None) -> None:
        self._path = path
        self._rest = b""
        self._inode = -1
        self._position = 0
        if last is not None:
            self._position, self._inode = _start_of_last(path, last)

    def new_lines(self) -> Iterator[str]:
        """Yield the whole lines that were added since the last call."""
        try:
            file = open(self._path, "rb")  # noqa: SIM115 - closed below, in every case
        except OSError:
            return
        with file:
            stat = os.fstat(file.fileno())
            if stat.st_ino != self._inode or stat.st_size < self._position:
                self._inode, self._position, self._rest = stat.st_ino, 0, b""
            file.seek(self._position)
            while chunk := file.read(_CHUNK_BYTES):
                self._position += len(chunk)
                *whole, self._rest = (self._rest + chunk).split(b"\n")
                for line in whole:
                    yield line.decode(errors="replace").rstrip("\r")


def _start_of_last(path: Path, count: int) -> tuple[int, int]:
    try:
        with open(path, "rb") as file:
            stat = os.fstat(file.fileno())
            position, newlines = stat.st_size, 0
            while position > 0 and newlines <= count:
                step = min(_CHUNK_BYTES, position)
                position -= step
                file.seek(position)
                newlines += file.read(step).count(b"\n")
            file.seek(position)
            for _ in range(newlines - count):
                file.readline()
            return file.tell(), stat.st_ino
    except OSError:
        return 0, -1
