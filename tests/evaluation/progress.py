"""Progress bars on a terminal, a line now and then elsewhere; all to standard error."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

_LINE_EACH_S = 15.0


class Bars:
    """One bar an experiment. Use as a context manager."""

    def __init__(self) -> None:
        self._bars: Any = None
        self._said = 0.0

    def __enter__(self) -> Bars:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import (
                BarColumn,
                MofNCompleteColumn,
                Progress,
                TextColumn,
                TimeRemainingColumn,
            )

            self._bars = Progress(
                TextColumn("{task.description:<13}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
                console=Console(stderr=True),
            )
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bars:
            self._bars.stop()

    def of(self, name: str) -> Callable[[int, int], None]:
        """Return what shows an experiment's progress."""
        task = self._bars.add_task(name, total=None) if self._bars else None

        def advance(done: int, all: int) -> None:
            if self._bars:
                self._bars.update(task, completed=done, total=all)
            elif done == all or time.monotonic() > self._said + _LINE_EACH_S:
                self._said = time.monotonic()
                print(f"{name}: {done} of {all}", file=sys.stderr, flush=True)

        return advance

    def say(self, text: str) -> None:
        """Show a line."""
        if self._bars:
            self._bars.console.print(text)
        else:
            print(text, file=sys.stderr, flush=True)
