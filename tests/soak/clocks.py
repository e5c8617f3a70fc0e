"""Set the system clock of single processes, as if each were a machine of its own (`clock.c`)."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
from collections.abc import Iterable
from pathlib import Path


def can_set() -> bool:
    """Whether there is a compiler."""
    return shutil.which("gcc") is not None


class Clocks:
    """Clocks of the processes that are started after this was made.

    Args:
        folder: For the clocks' files.
        one: Whether they all have the same clock, as on one machine.
    """

    def __init__(self, folder: Path, *, one: bool = False) -> None:
        self._folder = folder / "clocks"
        self._folder.mkdir()
        self._one = self._folder / "one"
        library = self._folder / "clock.so"
        source = Path(__file__).with_name("clock.c")
        command = ["gcc", "-shared", "-fPIC", "-O1", "-o", str(library), str(source)]
        subprocess.run(command, check=True)
        if one:
            self._one.write_bytes(bytes(8))
        os.environ["FOGFT_CLOCKS"] = str(self._one if one else self._folder)
        os.environ["LD_PRELOAD"] = str(library)

    def set(self, pids: Iterable[int], ahead_s: int) -> None:
        """Have these processes' clocks be so far ahead of the real one, or behind it."""
        for pid in pids:
            self._write(self._folder / str(pid), ahead_s)

    def set_all(self, ahead_s: int) -> None:
        """Have the one clock that all have be so far ahead of the real one, or behind it."""
        self._write(self._one, ahead_s)

    @staticmethod
    def _write(path: Path, ahead_s: int) -> None:
        with path.open("r+b") as file:
            file.write(struct.pack("l", ahead_s))
