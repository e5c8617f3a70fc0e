"""Another process hangs when its main thread never comes round, whatever the disk says."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from fogft.process import Hanging

LIMIT_S = 10.0


class Looks:
    """Looks a second of its own clock apart."""

    def __init__(self) -> None:
        self.now = 0.0
        self.hanging = Hanging(LIMIT_S, lambda: self.now)

    def found_after(self, pid: int | None, limit: int = 20, step_s: float = 1.0) -> int | None:
        """Return how many looks it took to see it hang; None where it was never seen."""
        for count in range(limit):
            if self.hanging.look(pid):
                return count
            self.now += step_s
            time.sleep(0.03)
        return None


@pytest.fixture
def start() -> Iterator[object]:
    started: list[subprocess.Popen[bytes]] = []

    def begin(code: str) -> int:
        process = subprocess.Popen([sys.executable, "-uc", f"print(1)\n{code}"], stdout=-1)
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline()
        return process.pid

    yield begin
    for process in started:
        process.kill()
        process.wait()


COMES_ROUND = "import time\nwhile True: time.sleep(0.005)"


@pytest.mark.parametrize(
    "code",
    [
        "while True: pass",
        "import threading; threading.Event().wait()",
        "import threading, time\n"
        "threading.Thread(target=lambda: [time.sleep(0.005) for _ in range(10**6)]).start()\n"
        "threading.Lock().acquire() and threading.Event().wait()",
    ],
)
def test_one_whose_main_thread_never_comes_round_hangs(start, code):
    found = Looks().found_after(start(code))
    assert found is not None
    assert found > LIMIT_S


def test_one_that_comes_round_does_not_hang_and_a_stopped_one_does(start):
    looks, pid = Looks(), start(COMES_ROUND)
    assert looks.found_after(pid) is None
    os.kill(pid, signal.SIGSTOP)
    assert looks.found_after(pid) is not None
    os.kill(pid, signal.SIGCONT)
    end = time.monotonic() + 60
    while looks.hanging.look(pid):  # until it has had a turn
        assert time.monotonic() < end
        time.sleep(0.01)
    assert looks.found_after(pid, limit=5) is None


def test_a_pause_of_our_own_is_not_held_against_it(start):
    """A suspend of minutes stops both, and we may be the first to wake."""
    looks, pid = Looks(), start(COMES_ROUND)
    os.kill(pid, signal.SIGSTOP)
    assert looks.found_after(pid, limit=3, step_s=600.0) is None


def test_who_is_not_there_or_has_just_come_does_not_hang(start):
    looks = Looks()
    assert looks.found_after(None) is None
    assert looks.found_after(2**22 + 1) is None
    for _ in range(3):
        pid = start("import threading; threading.Event().wait()")
        assert looks.found_after(pid, limit=8) is None


def test_the_kernel_counts_here():
    assert "voluntary_ctxt_switches" in Path("/proc/self/status").read_text()
