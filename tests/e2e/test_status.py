"""What `fogft status` says of processes that hang, die and come back."""

from __future__ import annotations

import os
import signal

import pytest

from fogft.pool.folder.paths import PoolPaths
from fogft.pool.manager.process_control import lock_holder
from tests.e2e.pool import Pool

pytestmark = pytest.mark.timeout(300)


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
    return pool.start("status", "--check").wait(30) == 0


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
