"""Freeze a process, so that it surely does nothing more."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from tests.fakes.waiting import wait_for


def freeze(pid: int) -> None:
    """Stop a process, and return once all its threads have: on another processor, they go on."""
    os.kill(pid, signal.SIGSTOP)
    wait_for(lambda: all(_stopped(task) for task in Path(f"/proc/{pid}/task").iterdir()))


def _stopped(task: Path) -> bool:
    try:
        return (task / "stat").read_text().rpartition(")")[2].split()[0] in "TtZX"
    except OSError:  # it has ended
        return True
