"""Processes are found by the locks they hold and ended for sure; nobody else is touched."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fogft import disk
from fogft.model.reason import Cause
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.manager import process_control
from fogft.pool.manager.proxy_supervisor import BACKOFF_LIMIT_S, ProxySupervisor

HOLD = """
import signal, sys, time
from pathlib import Path
from fogft import disk
if "stubborn" in sys.argv:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
lock = disk.Lock(Path(sys.argv[1]))
assert lock.acquire(wait=False)
if "lingering" in sys.argv:
    signal.signal(signal.SIGTERM, lambda number, frame: lock.release())
print("held", flush=True)
time.sleep(60)
"""


@pytest.fixture
def lock(tmp_path: Path) -> Path:
    return tmp_path / "a.lock"


@pytest.fixture
def holders(lock: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Processes to be ended with the test."""
    started: list[subprocess.Popen[bytes]] = []
    yield started
    for process in started:
        process.kill()
        process.wait()


def hold(lock: Path, holders: list[subprocess.Popen[bytes]], *words: str) -> int:
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(lock), *words], stdout=-1)
    holders.append(process)
    assert process.stdout is not None
    assert process.stdout.readline() == b"held\n"
    return process.pid


def test_the_holder_of_a_lock_is_known(lock: Path, holders: list[subprocess.Popen[bytes]]) -> None:
    """By the kernel's list, whatever any file says; nobody holds what is free or missing."""
    assert process_control.lock_holder(lock) is None
    pid = hold(lock, holders)
    assert process_control.lock_holder(lock) == pid
    holders[0].kill()
    holders[0].wait()
    assert process_control.lock_holder(lock) is None


@pytest.mark.parametrize("kind", ["willing", "stubborn", "stopped", "lingering"])
def test_the_holder_is_ended(lock: Path, holders: list[subprocess.Popen[bytes]], kind: str) -> None:
    """SIGTERM first; SIGKILL for one that ignores it; a stopped one is let go on to hear it.

    One that lets go of its lock and then hangs is ended too.
    """
    pid = hold(lock, holders, kind)
    if kind == "stopped":
        os.kill(pid, signal.SIGSTOP)
    wrong = os.getppid()
    ended = process_control.end_holder(lock, suspected_pid=wrong, patience_s=0.5)
    assert ended == pid
    expected = signal.SIGTERM if kind in ("willing", "stopped") else signal.SIGKILL
    assert holders[0].wait(10) == -expected


def test_nobody_is_ended_where_nobody_holds_the_lock(lock: Path) -> None:
    """A stale process id in a file is never signalled."""
    lock.touch()
    assert process_control.end_holder(lock, suspected_pid=1) is None


class Proxy:
    """A supervisor whose clock and command a test sets."""

    def __init__(self, folder: Path, code: str) -> None:
        self.now = 1000.0
        self.paths = PoolPaths(folder)
        command = [sys.executable, "-c", code]
        self.supervisor = ProxySupervisor(self.paths, lambda: self.now, command)

    def look_until_ended(self) -> None:
        assert self.supervisor.look()
        assert self.supervisor.child is not None
        self.supervisor.child.wait(20)


def test_a_proxy_that_keeps_dying_is_started_less_and_less_often(tmp_path: Path) -> None:
    """Its restarts back off up to a limit, and its trouble is told with the log's name."""
    proxy = Proxy(tmp_path, "raise SystemExit(3)")
    waits = []
    proxy.look_until_ended()
    for _ in range(7):
        died_at = proxy.now
        while not proxy.supervisor.look():
            proxy.now += 0.5
        waits.append(proxy.now - died_at)
        assert proxy.supervisor.child is not None
        proxy.supervisor.child.wait(20)
    assert waits == sorted(waits)
    assert waits[-1] <= BACKOFF_LIMIT_S
    assert waits[0] < 2
    proxy.supervisor.look()
    trouble = proxy.supervisor.trouble
    assert trouble is not None
    assert (trouble.cause, trouble.name) == (Cause.PROXY_KEEPS_ENDING, str(proxy.paths.proxy_log))


def test_a_proxy_that_ran_well_is_started_again_at_once(tmp_path: Path) -> None:
    """After half a minute of life there is no waiting."""
    proxy = Proxy(tmp_path, "raise SystemExit(3)")
    proxy.look_until_ended()
    proxy.now += 31
    assert proxy.supervisor.look()
    assert proxy.supervisor.trouble is None
    assert proxy.supervisor.child is not None
    proxy.supervisor.child.wait(20)


def test_a_running_proxy_is_adopted(tmp_path: Path) -> None:
    """Whoever holds its lock is the proxy; no second one is started."""
    proxy = Proxy(tmp_path, "raise SystemExit(3)")
    held = disk.Lock(proxy.paths.proxy_lock)
    assert held.acquire(wait=False)
    assert proxy.supervisor.look()
    assert proxy.supervisor.child is None
    held.release()
