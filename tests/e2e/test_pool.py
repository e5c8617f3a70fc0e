"""The main job: a service goes on answering while its replicas die."""

from __future__ import annotations

import os
import random
import signal
import time

import pytest

from fogft.doctor.finding import Situation
from fogft.doctor.pools import processes
from tests.e2e.pool import Pool, run
from tests.nightly import by_day

pytestmark = [pytest.mark.e2e, pytest.mark.ros, pytest.mark.timeout(400)]


def flawless(result: dict) -> bool:
    return result["failed"] == result["wrong"] == result["twice"] == 0


@pytest.mark.parametrize("seed", [20261])
def test_no_answer_is_lost_or_wrong_while_replicas_die(pool, seed):
    """Requests under kills and freezes of both kinds, one replica always spared at a time."""
    under_fire_s = by_day(10, at_night=120)
    pool.up()
    client = pool.client(300, 25)
    chance = random.Random(seed)
    end = time.monotonic() + under_fire_s
    faults = []
    while time.monotonic() < end or len({kind for kind, _ in faults}) < 2:
        ready = [r["slot"] for r in pool.status()["replicas"] if r["phase"] == "ready"]
        if len(ready) > 1:
            slot, kind = chance.choice(ready), chance.choice(["kill", "freeze"])
            if len(faults) == 1:  # both kinds, however few there is time for
                kind = "kill" if faults[0][0] == "freeze" else "freeze"
            pool.fogft("chaos", kind, str(slot))
            faults.append((kind, slot))
            if kind == "freeze" and chance.random() < 0.5:
                time.sleep(chance.uniform(1, 4))
                pool.fogft("chaos", "thaw", str(slot), ok=False)
        time.sleep(chance.uniform(0.5, 2.0))
    result = client.finish()
    assert result["requests"] > 15 * under_fire_s
    assert flawless(result), (result, faults)
    pool.wait(lambda: pool.ready() == 3)
    pool.fogft("down")
    assert pool.left() == {}


def test_a_slow_service_is_never_taken_for_a_dead_one_and_replicas_without_a_manager_end(pool):
    """Who thinks six times longer than the suspicion limit is left in peace.

    Whatever became of the manager, nothing runs and costs for ever.
    """
    pool.write(
        replicas=1,
        work_s=3.0,
        more="  health: {suspect_after_s: 0.5, replace_after_s: 1.0}\n"
        "  unmanaged_max_hours: 0.006\n",
    )
    pool.up()
    before = {(r["slot"], r["generation"]) for r in pool.status()["replicas"]}
    result = pool.client(6, 0.5, limit_s=20).result()
    assert flawless(result)
    after = pool.status()
    assert {(r["slot"], r["generation"]) for r in after["replicas"]} == before
    assert all(r["phase"] == "ready" for r in after["replicas"])
    os.kill(after["manager_pid"], signal.SIGTERM)  # one that is killed would be started again
    pool.wait(lambda: len(pool.processes()) <= 3)  # the client proxies live on
    assert after["proxy_pid"] in pool.processes()


def test_a_pool_is_scaled_adopted_and_ended_under_load(pool):
    """Scaled up; one gets a notice; its manager dies and the next one adopts it; scaled down.

    Then all of the robot's side hangs, and dies; `status` and `doctor` say what is so.

    A command that waits returns when what it asked for is done.
    At a notice the successor is launched and serves long before the machine's 60 s are over.
    """
    pool.write(replicas=1)
    pool.up()
    client = pool.client(120, 5)
    pool.fogft("scale", "up", "1", "--wait")
    assert pool.ready() == 2

    pool.fogft("chaos", "preempt", "0", "--notice", "60")
    pool.wait(
        lambda: any(
            (r["slot"], r["generation"], r["phase"]) == (0, 2, "ready")
            for r in pool.status()["replicas"]
        )
    )
    events = [(e["event"], e["replica"]) for e in pool.status()["events"]]
    assert ("gone", "0.1") not in events, "the old one was to live for a minute"
    pool.wait(lambda: len(pool.status()["replicas"]) == pool.ready() == 2)
    events = [(e["event"], e["replica"]) for e in pool.status()["events"]]
    assert events.index(("launched", "0.2")) < events.index(("ending", "0.1"))

    before = {(r["slot"], r["generation"]) for r in pool.status()["replicas"]}
    os.kill(pool.status()["manager_pid"], signal.SIGKILL)
    time.sleep(1)  # a second of requests that no manager sees
    pool.fogft("up", str(pool.file), "--yes")
    pool.wait(lambda: pool.ready() == 2)
    assert {(r["slot"], r["generation"]) for r in pool.status()["replicas"]} == before
    pool.fogft("drain", "1", "--wait")
    assert max(r["generation"] for r in pool.status()["replicas"] if r["slot"] == 1) > 1
    pool.fogft("scale", "down", "1", "--wait")
    assert [r["phase"] for r in pool.status()["replicas"]] == ["ready"]
    assert flawless(client.finish())

    status_says_what_is_true_now(pool)
    manager, proxy, *_ = pool.robot_side()  # the next one is in line
    for pid in (manager, proxy):
        os.kill(pid, signal.SIGKILL)
    pool.fogft("down")
    # The proxy may have started a manager before it was killed too: that finds no pool and ends.
    pool.wait(lambda: not pool.left())
    pool.fogft("down", ok=False)


def status_says_what_is_true_now(pool: Pool) -> None:
    """Of a robot's side that hangs nothing is claimed; of a dead one, that nothing is answered."""
    assert answers(pool)
    all_of_it = pool.robot_side()
    for pid in all_of_it:
        os.kill(pid, signal.SIGSTOP)
    pool.wait(lambda: pool.status()["answers"] is None)
    assert pool.status()["ready"] == 0
    assert not answers(pool)
    assert "answering?" in pool.fogft("status")
    for pid in all_of_it:
        os.kill(pid, signal.SIGCONT)
    pool.wait(lambda: answers(pool))

    pool.kill_robot_side()
    assert not answers(pool)
    seen = pool.status()
    assert (seen["answers"], seen["ready"], seen["proxy_alive"]) == (False, 0, False)
    assert not any(one["link"] for one in seen["replicas"])
    judged = processes(Situation(pool.home, ("e2e",), now=time.time()))
    assert "no request is answered" in str([*judged])
    pool.fogft("up", str(pool.file), "--yes")  # what doctor says to do
    pool.wait(lambda: answers(pool))


def answers(pool: Pool) -> bool:
    """Return what `fogft status --check` exits by."""
    return run(("status", "--check"), pool.environ, pool.folder, 120).returncode == 0
