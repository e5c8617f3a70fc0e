"""What `fogft status` says of processes that hang, die and come back; what commands wait for."""

from __future__ import annotations

import os
import signal
import sys
from subprocess import DEVNULL, Popen

import pytest

from fogft.pool.folder.paths import PoolPaths
from fogft.pool.manager.process_control import lock_holder
from tests.e2e.pool import Pool

pytestmark = pytest.mark.timeout(300)


def start(pool: Pool, *words: str) -> Popen[bytes]:
    """Run a command beside others."""
    command = [sys.executable, "-m", "fogft", *words]
    return Popen(command, env=pool.environ, cwd=pool.folder, stdout=DEVNULL, stderr=DEVNULL)


def pids(pool: Pool) -> list[int]:
    """Return the processes of the robot's side: the manager, the client proxy, and its standby."""
    [folder] = (pool.folder / "home" / "pools").iterdir()
    paths = PoolPaths(folder)
    standby = pool.wait(lambda: lock_holder(paths.standby_lock), 30)
    manager, proxy = lock_holder(paths.manager_lock), pool.status()["proxy_pid"]
    assert manager is not None
    return [manager, proxy, standby]


def answers(pool: Pool) -> bool:
    """Return what `fogft status --check` exits by."""
    return start(pool, "status", "--check").wait(30) == 0


def test_status_says_what_is_true_now(pool: Pool) -> None:
    """Of a robot's side that hangs nothing is claimed; of a dead one, that nothing is answered."""
    pool.write(replicas=2)
    pool.up()
    assert answers(pool)

    all_of_it = pids(pool)
    for pid in all_of_it:
        os.kill(pid, signal.SIGSTOP)
    pool.wait(lambda: pool.status()["answers"] is None, 20)
    assert pool.status()["ready"] == 0
    assert not answers(pool)
    assert "answering?" in pool.fogft("status")
    for pid in all_of_it:
        os.kill(pid, signal.SIGCONT)
    pool.wait(lambda: answers(pool), 30)

    all_of_it = pids(pool)
    for number in (signal.SIGSTOP, signal.SIGKILL):  # none of them has the time to start another
        for pid in all_of_it:
            os.kill(pid, number)
    assert not answers(pool)
    seen = pool.status()
    assert (seen["answers"], seen["ready"], seen["proxy_alive"]) == (False, 0, False)
    assert not any(one["link"] for one in seen["replicas"])
    told = pool.fogft("doctor", ok=False)
    assert "no request is answered" in told
    pool.fogft("up", str(pool.file), "--yes")  # what doctor says to do
    pool.wait(lambda: answers(pool), 30)


def test_a_command_that_waits_returns_when_it_is_done(pool: Pool) -> None:
    """A drain, more and fewer replicas, and a second `up` during an update."""
    pool.write(replicas=2)
    pool.up()
    before = {one["slot"]: one["generation"] for one in pool.status()["replicas"]}
    pool.fogft("drain", "0", "--wait")
    after = {one["slot"]: one["generation"] for one in pool.status()["replicas"]}
    assert after[0] > before[0]
    pool.fogft("scale", "up", "1", "--wait")
    assert pool.ready() == 3
    pool.fogft("scale", "down", "1", "--wait")
    assert len(pool.status()["replicas"]) == 2

    pool.write(replicas=2, work_s=0.006)
    first = start(pool, "up", str(pool.file), "--yes")
    pool.wait(lambda: pool.status()["update"] is not None, 30)
    joined = start(pool, "up", str(pool.file), "--yes")
    assert joined.wait(120) == 0
    assert pool.status()["update"] is None, "it returned before the update had ended"
    assert first.wait(30) == 0
