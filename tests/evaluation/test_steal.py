"""Processor time is really taken from a process, and given back."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.evaluation.steal import steal
from tests.fakes.waiting import wait_for


@pytest.fixture
def busy():
    """A process that uses all the processor time it can have."""
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    yield process
    process.kill()
    process.wait()


def state(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0]


def used_s(pid: int) -> float:
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0]) / 1e9


def test_what_is_stolen_is_not_used(busy):
    """A stopped process uses nothing: it gets at most what was left of the time."""
    before, began = used_s(busy.pid), time.perf_counter()
    with steal([busy.pid], 20.0) as stolen:
        wait_for(lambda: stolen.stops >= 20, 60.0)
    left_s = time.perf_counter() - began - stolen.seconds
    assert stolen.seconds > 0
    # A stop takes effect when the process next enters the kernel: a tick each, at most.
    assert used_s(busy.pid) - before <= left_s + stolen.stops * 0.01


def test_it_runs_on_afterwards(busy):
    with steal([busy.pid], 5.0):
        pass
    before = used_s(busy.pid)
    wait_for(lambda: used_s(busy.pid) != before, 60.0)
    assert state(busy.pid) != "T"


def test_it_runs_on_after_an_error(busy):
    with pytest.raises(RuntimeError), steal([busy.pid], 5.0):
        raise RuntimeError
    assert state(busy.pid) != "T"


def test_nothing_is_stolen_from_nobody_and_from_the_dead(busy):
    with steal([], 20.0) as stolen:
        pass
    assert (stolen.stops, stolen.seconds) == (0, 0.0)
    busy.kill()
    busy.wait()
    with steal([busy.pid], 20.0):
        pass
