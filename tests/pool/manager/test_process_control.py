"""Processes are found by the locks they hold and ended for sure; nobody else is touched."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from fogft import disk
from fogft.model.reason import Cause
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.manager import process_control
from fogft.pool.manager.proxy_supervisor import BACKOFF_LIMIT_S, STEADY_S, ProxySupervisor
from tests.fakes.waiting import let_come_round
from tests.link.freezing import freeze
from tests.needs import needs

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
while True:
    time.sleep(0.1)
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
    assert disk.holder(lock) is None
    pid = hold(lock, holders)
    assert disk.holder(lock) == pid
    holders[0].kill()
    holders[0].wait()
    assert disk.holder(lock) is None


OVERLAY = """
set -e
mount -t tmpfs tmpfs "$1"
mkdir "$1/upper" "$1/work" "$1/root"
mount -t overlay overlay -o "lowerdir=/etc,upperdir=$1/upper,workdir=$1/work" "$1/root"
"$2" -c "$3" "$1/root/a.lock" > "$1/said" &
until grep -q held "$1/said"; do sleep 0.02; done
"$2" -c "
import sys
from pathlib import Path
from fogft.disk import holder
print(holder(Path(sys.argv[1])))
" "$1/root/a.lock"
echo $!
kill $!
"""


@needs("namespaces")
def test_the_holder_is_known_in_a_container_too(tmp_path: Path) -> None:
    """On an overlay of two file systems the kernel's list names another device than `stat`."""
    words = ["unshare", "--mount", "bash", "-c", OVERLAY, "bash"]
    done = subprocess.run(
        [*words, str(tmp_path), sys.executable, HOLD],
        capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found, holder = done.stdout.split()
    assert found == holder


@pytest.mark.parametrize("kind", ["willing", "stubborn", "stopped", "lingering"])
def test_the_holder_is_ended(lock: Path, holders: list[subprocess.Popen[bytes]], kind: str) -> None:
    """SIGTERM first; SIGKILL for one that ignores it; a stopped one is let go on to hear it.

    One that lets go of its lock and then hangs is ended too.
    """
    pid = hold(lock, holders, kind)
    if kind == "stopped":
        os.kill(pid, signal.SIGSTOP)
    expected = signal.SIGTERM if kind in ("willing", "stopped") else signal.SIGKILL
    patience_s = 10.0 if expected is signal.SIGTERM else 0.5
    ended = process_control.end_holder(lock, patience_s=patience_s)
    assert ended == pid
    assert holders[0].wait(10) == -expected


def test_nobody_is_ended_where_nobody_holds_the_lock(lock: Path) -> None:
    """A stale process id in a file is never signalled."""
    lock.write_text("1")
    assert process_control.end_holder(lock) is None


class Proxy:
    """A supervisor whose clock and command a test sets."""

    def __init__(self, folder: Path, code: str) -> None:
        self.now = 1000.0
        self.paths = PoolPaths(folder)
        command = [sys.executable, "-c", code]
        self.ended = threading.Event()
        self.supervisor = ProxySupervisor(
            self.paths, lambda: self.now, command, ended=self.ended.set
        )

    def look_until_ended(self) -> None:
        """Have one started, and wait until it has ended."""
        self.ended.clear()
        assert self.supervisor.look()
        assert self.ended.wait(20)


def test_a_proxy_that_keeps_dying_is_started_less_and_less_often(tmp_path: Path) -> None:
    """The first restart is at once, then they back off; its trouble is told with the log's name."""
    proxy = Proxy(tmp_path, "raise SystemExit(3)")
    waits = []
    proxy.look_until_ended()
    for _ in range(7):
        died_at = proxy.now
        proxy.ended.clear()
        while not proxy.supervisor.look():
            proxy.now += 0.5
        waits.append(proxy.now - died_at)
        assert proxy.ended.wait(20)
    assert waits == sorted(waits)
    assert waits[-1] <= BACKOFF_LIMIT_S
    assert waits[:2] == [0.0, 1.0]  # the first at once
    proxy.supervisor.look()
    trouble = proxy.supervisor.trouble
    assert trouble is not None
    assert (trouble.cause, trouble.name) == (Cause.PROXY_KEEPS_ENDING, str(proxy.paths.proxy_log))
    assert trouble.words == "exited with status 3"


def test_a_proxy_that_ran_well_is_started_again_at_once(tmp_path: Path) -> None:
    """After some seconds of life there is no waiting: kills in a row are no bad start."""
    proxy = Proxy(tmp_path, "raise SystemExit(3)")
    for _ in range(3):
        proxy.look_until_ended()
        proxy.now += STEADY_S + 1
    assert proxy.supervisor.trouble is None


def test_a_running_proxy_is_adopted(tmp_path: Path) -> None:
    """Whoever holds its lock is the proxy; no second one is started."""
    proxy = Proxy(tmp_path, "raise SystemExit(3)")
    held = disk.Lock(proxy.paths.proxy_lock)
    assert held.acquire(wait=False)
    assert proxy.supervisor.look()
    assert not proxy.paths.proxy_log.exists()
    held.release()


def test_a_line_without_a_spare_gets_one(tmp_path: Path) -> None:
    """The one that takes over may be killed as well, a second later."""
    paths, ended = PoolPaths(tmp_path), threading.Event()
    held = disk.Lock(paths.standby_lock)
    assert held.acquire(wait=False)
    supervisor = ProxySupervisor(paths, lambda: 1000.0, ended=ended.set)
    assert supervisor.look()
    assert ended.wait(20)  # it lacks its configuration
    assert str(paths.proxy_config) in paths.proxy_log.read_text()
    held.release()


WORKS = "import sys, time\nfrom pathlib import Path\nfrom fogft import disk\n"
WORKS += "disk.Lock(Path(sys.argv[1])).acquire(wait=True)\nprint('held', flush=True)\n"
WORKS += "while True: time.sleep(0.01)"


def test_a_proxy_that_was_replaced_is_counted(tmp_path: Path) -> None:
    """Not the first one, nor one that is looked at again."""
    proxy = Proxy(tmp_path, "pass")
    for replaced in (0, 1):
        works = subprocess.Popen(
            [sys.executable, "-c", WORKS, str(proxy.paths.proxy_lock)], stdout=subprocess.PIPE
        )
        assert works.stdout is not None
        works.stdout.readline()
        proxy.supervisor.look()
        proxy.supervisor.look()
        assert proxy.supervisor.replacements == replaced
        works.kill()
        works.communicate()
        proxy.supervisor.look()


@pytest.mark.parametrize("which", ["proxy_lock", "standby_lock", "spare_lock"])
def test_a_proxy_that_hangs_is_killed(tmp_path: Path, which: str) -> None:
    """Stopped, it holds its place for ever, and nobody can take over; one that works is let be."""
    proxy = Proxy(tmp_path, "pass")
    words = [sys.executable, "-c", WORKS, str(getattr(proxy.paths, which))]
    works = subprocess.Popen(words, stdout=-1)
    try:
        assert works.stdout is not None
        works.stdout.readline()
        for _ in range(15):
            let_come_round(works.pid)
            proxy.supervisor.look()
            proxy.now += 1.0
        assert works.poll() is None
        freeze(works.pid)
        for _ in range(15):
            proxy.supervisor.look()
            proxy.now += 1.0
        assert works.wait(20) == -signal.SIGKILL
    finally:
        works.kill()
        works.communicate()
