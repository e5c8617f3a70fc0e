"""Waiting for a condition, never for a time: and doing the same again and again until it holds."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")


def wait_for(
    condition: Callable[[], T],
    limit_s: float = 30.0,
    what: object = "the awaited condition",
    *,
    told: Callable[[], object] = lambda: "",
    pause_s: float = 0.01,
) -> T:
    """Return what a condition gives once that is true; fail with what was awaited, and `told`.

    The first looks are quick after one another; the longest pause between two is `pause_s`.
    """
    end, pause = time.monotonic() + limit_s, min(0.001, pause_s)
    while not (value := condition()):
        assert time.monotonic() < end, f"waited {limit_s:g} s in vain: {what} {told()}"
        time.sleep(pause)
        pause = min(1.5 * pause, pause_s)
    return value


def paced(pause_s: float, *, seconds: float = float("inf")) -> Iterator[int]:
    """Yield the numbers of turns, for so long at most, with a pause after each turn."""
    end, turn = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        yield turn
        turn += 1
        time.sleep(pause_s)


def let_come_round(pid: int) -> None:
    """Return once a process has gone to sleep again, by the kernel's count."""

    def sleeps() -> int:
        told = Path(f"/proc/{pid}/status").read_text()
        return int(told.partition("\nvoluntary_ctxt_switches:")[2].split()[0])

    before = sleeps()
    wait_for(lambda: sleeps() > before)
