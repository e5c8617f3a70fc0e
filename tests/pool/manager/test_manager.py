"""The manager as a real process: killed, stopped, doubled, and told what to do by files."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from fogft import __version__, disk, logfile
from fogft.errors import PoolBusy, StateError
from fogft.model import intent as intents
from fogft.model.credentials import Role
from fogft.pool.commands import startup
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.lease import TERM, Lease, read_epoch
from fogft.pool.manager import process_control, teardown
from fogft.pool.manager.manager import Manager
from fogft.pool.manager.reconciler import Reconciler
from fogft.records import cache
from fogft.records.record import read_body
from tests.fakes.threads import no_more
from tests.pool.scene import Scene


def test_manager_brings_up_what_the_file_asks_for(scene: Scene) -> None:
    """A started manager launches, certifies, configures and reports."""
    scene.write(replicas=2)
    scene.start_manager()
    scene.wait(lambda: scene.whole(2))
    assert scene.running() == ["0.1", "1.1"]
    assert len({r["location"] for r in scene.status()["replicas"]}) == 2
    for private in (scene.paths.proxy_config, scene.paths.credentials / "robot.key"):
        assert private.stat().st_mode & 0o777 == 0o600
    machine = disk.read_json(next(scene.cloud.folder.glob("*.json")))
    assert machine["files"] == [
        "announcements.json",
        "ca.crt",
        "replica.crt",
        "replica.key",
        "replica.yaml",
    ]


@contextlib.contextmanager
def on_a_thread(scene: Scene) -> Iterator[threading.Thread]:
    """Run a manager in this process, where a test can replace parts of it; then stop it."""
    stop = threading.Event()
    manager = Manager(scene.store, scene.cloud, keeps_proxy=False)
    running = threading.Thread(target=manager.run, args=(stop,))
    running.start()
    try:
        yield running
    finally:
        stop.set()
        running.join()


def with_a_second_manager(scene: Scene, replicas: int) -> int:
    """Kill a manager once its pool is whole, and start another; return the client proxy's pid."""
    first = scene.start_manager()
    scene.wait(lambda: scene.whole(replicas))
    proxy: int = scene.status()["proxy_pid"]
    first.send_signal(signal.SIGKILL)
    first.wait()
    scene.start_manager()
    return proxy


def test_killed_manager_stops_nothing_and_the_next_one_adopts(scene: Scene) -> None:
    """SIGKILL of the manager costs no machine and no proxy; its successor launches nothing."""
    scene.write(replicas=2)
    proxy = with_a_second_manager(scene, 2)
    scene.wait(lambda: scene.status().get("epoch") == 2 and scene.whole(2))
    assert scene.cloud.launched() == ["0.1", "1.1"]
    assert scene.status()["proxy_pid"] == proxy


def test_sigterm_ends_the_managing_only(scene: Scene) -> None:
    """A manager told to stop exits cleanly and leaves machines and client proxy running."""
    scene.write(replicas=1)
    process = scene.start_manager()
    scene.wait(lambda: scene.whole(1))
    process.terminate()
    assert process.wait(20) == 0
    assert scene.running() == ["0.1"]
    assert disk.is_locked(scene.paths.proxy_lock)
    assert not disk.is_locked(scene.paths.manager_lock)


def test_second_manager_is_refused(scene: Scene) -> None:
    """One pool, one manager: the second says who is in office and changes nothing."""
    scene.write()
    scene.start_manager()
    scene.wait(lambda: scene.whole(2))
    second = scene.start_manager()
    assert second.wait(20) == 1
    assert "already has a manager (pid" in scene.output()
    assert scene.cloud.launched() == ["0.1", "1.1"]


def test_manager_of_an_older_epoch_steps_down(scene: Scene) -> None:
    """A manager that finds a later epoch in the lease stops at once."""
    scene.write(replicas=1)
    process = scene.start_manager()
    scene.wait(lambda: scene.whole(1))

    def ended() -> bool:  # a beat that has just looked may write over it
        disk.write_json(scene.paths.lease, {"epoch": 99, "pid": 1, "beat": 0})
        return process.poll() is not None

    scene.wait(ended)
    assert process.wait(20) == 1
    assert "a later manager has taken over" in scene.output()


def test_scale_and_file_change_reach_a_running_manager(scene: Scene) -> None:
    """What the commands write into the folder is acted upon, without a signal or a socket."""
    scene.write(replicas=1)
    scene.start_manager()
    scene.wait(lambda: scene.whole(1))
    scene.store.write_intent(intents.scale(scene.store.intent(), scene.store.spec(), 2, 0.0))
    scene.wait(lambda: scene.whole(3))
    assert "timeout_s: 5.0" in scene.paths.proxy_config.read_text()
    scene.write(replicas=2, timeout_s=7.0)
    scene.wait(lambda: scene.whole(2))
    scene.wait(lambda: "timeout_s: 7.0" in scene.paths.proxy_config.read_text())


def test_a_client_proxy_that_tells_no_version_is_replaced(scene: Scene) -> None:
    """It is of a fogft before 0.2.0: what is written for it now it may not read."""
    scene.write(replicas=1)
    (scene.paths.folder / "version").write_text("")
    proxy = with_a_second_manager(scene, 1)
    scene.wait(lambda: scene.whole(1) and scene.status()["proxy_pid"] not in (None, proxy))


def test_dead_proxy_is_started_again(scene: Scene) -> None:
    """The client proxy comes back under a new pid, and no replica is touched for it."""
    scene.write(replicas=1)
    scene.start_manager()
    scene.wait(lambda: scene.whole(1))
    old = scene.status()["proxy_pid"]
    os.kill(old, signal.SIGKILL)
    scene.wait(lambda: scene.status()["proxy_pid"] not in (None, old))
    assert scene.cloud.launched() == ["0.1"]


def test_a_notice_is_answered_with_a_replacement_while_the_old_one_lives(scene: Scene) -> None:
    """A replica asks to be left alone: the next one is launched at once, elsewhere.

    The cloud knows of no notice here, as with real clouds: the link alone tells.
    """
    scene.write(replicas=2)
    scene.start_manager()
    scene.wait(lambda: scene.whole(2))
    lost_in = next(r["location"] for r in scene.status()["replicas"] if r["slot"] == 1)
    keeping = scene.cloud.keep("1.1")
    (scene.paths.folder / "draining").write_text("1.1")
    scene.wait(lambda: "1.2" in scene.cloud.launched())
    assert "1.1" in scene.running()
    keeping.unlink()
    scene.wait(lambda: scene.running() == ["0.1", "1.2"] and scene.whole(2))
    events = [(e["event"], e["replica"]) for e in scene.status()["events"]]
    assert events.index(("launched", "1.2")) < events.index(("ending", "1.1"))
    [after] = [r["location"] for r in scene.status()["replicas"] if r["slot"] == 1]
    assert after != lost_in


def test_a_certificate_that_expires_soon_is_replaced_with_its_machine_new_before_old(
    scene: Scene,
) -> None:
    """An expired one would leave the replica out when its link is opened next; all at once."""
    scene.write(replicas=2)
    scene.start_manager()
    scene.wait(lambda: scene.whole(2))
    path = scene.paths.credentials / "issued.json"
    told = disk.read_json(path)
    for entry in told["issued"]:
        if entry["common_name"].startswith("replica.0.1."):
            entry["not_after"] -= 310 * 86_400
    disk.write_json(path, told)
    scene.wait(lambda: scene.running() == ["0.2", "1.1"] and scene.whole(2))
    events = [(e["event"], e["replica"]) for e in scene.status()["events"]]
    assert events.index(("ready", "0.2")) < events.index(("ending", "0.1"))
    [why] = [e["reason"] for e in scene.status()["events"] if e["event"] == "ending"]
    assert why == {"cause": "replaced", "because": [{"cause": "certificate_due"}]}


def test_a_damaged_list_of_certificates_keeps_no_machine(scene: Scene) -> None:
    """Nothing is launched without it; what has to end does."""
    scene.write(replicas=2)
    scene.start_manager()
    scene.wait(lambda: scene.whole(2))
    (scene.paths.credentials / "issued.json").write_text("damaged")
    scene.let_hours_pass(200)
    scene.wait(lambda: scene.running() == [])


def test_a_pool_ends_by_itself_when_its_hours_are_over(scene: Scene) -> None:
    """Machines, client proxy and manager go; the folder says why; `up` gives the hours again."""
    scene.write(replicas=2, max_hours=2)
    scene.let_hours_pass(2)
    scene.write(replicas=2, max_hours=2)  # `up` on a pool whose hours are over
    scene.let_hours_pass(1.9)
    process = scene.start_manager()
    scene.wait(lambda: scene.whole(2))
    scene.write(replicas=2, max_hours=0.0001)  # the file takes them away
    assert process.wait(30) == 0
    assert scene.running() == []
    assert not disk.is_locked(scene.paths.proxy_lock)
    status = scene.status()
    assert status["ended"] == "automatically, after 0.0001 hours (`max_hours`)"
    assert (status["replicas"], status["proxy_alive"]) == ([], False)
    assert "`max_hours` has passed" in {e["detail"] for e in status["events"]}
    scene.write(replicas=2, max_hours=2)
    scene.start_manager()
    scene.wait(lambda: scene.whole(2) and not scene.status()["ended"])
    assert scene.running() == ["0.2", "1.2"]


def test_hours_that_are_over_end_a_pool_that_had_no_manager(scene: Scene) -> None:
    """Killed before the end, and started again after it: it launches nothing, and cleans up."""
    scene.write(replicas=1, max_hours=2)
    first = scene.start_manager()
    scene.wait(lambda: scene.whole(1))
    first.send_signal(signal.SIGKILL)
    first.wait()
    scene.let_hours_pass(2)
    assert scene.start_manager().wait(30) == 0
    assert scene.running() == []
    assert scene.cloud.launched() == ["0.1"]
    assert not disk.is_locked(scene.paths.proxy_lock)


def test_a_cloud_that_does_not_answer_does_not_end_the_ending(scene: Scene) -> None:
    """Over, and the cloud is silent: the manager stays until it is certain that nothing runs."""
    scene.write(replicas=1, max_hours=2)
    process = scene.start_manager()
    scene.wait(lambda: scene.whole(1))
    (scene.cloud.folder / "outage").touch()
    scene.wait(lambda: not scene.status()["cloud_reachable"])
    scene.let_hours_pass(2)
    scene.wait(lambda: {"cause": "max_hours", "seconds": 7200.0} in scene.status()["reasons"])
    assert process.poll() is None
    (scene.cloud.folder / "outage").unlink()
    assert process.wait(30) == 0
    assert scene.running() == []


def test_unreachable_cloud_changes_nothing(scene: Scene) -> None:
    """While the cloud does not answer, status says so and keeps what was seen last."""
    scene.write(replicas=1)
    scene.start_manager()
    scene.wait(lambda: scene.whole(1))
    (scene.cloud.folder / "outage").touch()
    scene.wait(lambda: not scene.status()["cloud_reachable"])
    assert [r["slot"] for r in scene.status()["replicas"]] == [0]
    (scene.cloud.folder / "outage").unlink()
    scene.wait(lambda: scene.status()["cloud_reachable"] and scene.whole(1))
    assert scene.cloud.launched() == ["0.1"]


def test_lease_survives_damage_and_ends_with_its_holder(scene: Scene) -> None:
    """A damaged lease gives a higher epoch all the same, if the membership knows one."""
    scene.write()
    scene.paths.lease.write_text("{torn")
    lease = Lease(scene.paths, at_least=7)
    assert lease.epoch == 8
    with pytest.raises(PoolBusy, match=f"pid {os.getpid()}"):
        Lease(scene.paths)
    lease.release()
    assert Lease(scene.paths).epoch == 9


def test_who_holds_a_lease_whose_lock_was_removed_steps_down(scene: Scene) -> None:
    """Another manager may hold that of a new file in its place."""
    scene.write()
    lease = Lease(scene.paths)
    lease.beat()
    scene.paths.manager_lock.unlink()
    with pytest.raises(PoolBusy, match="a later manager has taken over"):
        lease.beat()
    lease.release()


def test_start_manager_reports_why_it_did_not_start(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A manager that dies at once is an error with the end of its log."""
    scene.write()
    dies = [sys.executable, "-c", "import sys; sys.exit('boom')"]
    monkeypatch.setattr(startup, "python", lambda *_: dies)
    with pytest.raises(Exception, match="did not start:\nboom"):
        startup.start_manager(scene.store)


def test_start_manager_starts_one_only_where_there_is_none(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`up` on a managed pool starts nothing."""
    scene.write(replicas=1)
    monkeypatch.setattr(startup, "python", lambda *words: scene.command(words[-1]))
    assert startup.start_manager(scene.store)
    scene.wait(lambda: scene.whole(1))
    assert not startup.start_manager(scene.store)
    assert [what.split(" ")[0] for what in scene.end()] == ["manager", "client", "replica"]


SLOW_TO_TELL = """\
import os, pathlib, signal, sys, time
from fogft import disk
lock, status = map(pathlib.Path, sys.argv[1:3])
held = disk.Lock(lock)
if not held.acquire(wait=False):
    sys.exit()
time.sleep(float(sys.argv[4]))
disk.write_json(status, {"manager_version": sys.argv[3], "manager_pid": os.getpid()})
signal.pause()
"""


def test_of_two_that_upgrade_a_manager_one_ends_it_and_none_its_successor(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two `up`s of a new version at once; the new manager has not written its status yet."""
    scene.write()
    paths = scene.paths

    def command(version: str, delay_s: float = 0.0) -> list[str]:
        words = [str(paths.manager_lock), str(paths.status), version, str(delay_s)]
        return [sys.executable, "-c", SLOW_TO_TELL, *words]

    monkeypatch.setattr(startup, "python", lambda *_: command("0.0.9"))
    assert startup.start_manager(scene.store)
    old = scene.wait(lambda: disk.holder(paths.manager_lock) if paths.status.exists() else None)
    monkeypatch.setattr(startup, "python", lambda *_: command(__version__, 1.0))
    with ThreadPoolExecutor() as both:
        asked = [both.submit(startup.start_manager, scene.store) for _ in range(2)]
        started = [one.result() for one in asked]
    new = disk.holder(paths.manager_lock)
    try:
        assert sorted(started) == [False, True]
        assert new is not None
        assert new != old
        assert json.loads(paths.status.read_text())["manager_pid"] == new
    finally:
        process_control.end_holder(paths.manager_lock)


def test_logs_of_the_pool_stay_bounded(scene: Scene) -> None:
    """The manager shortens its own log and the client proxy's."""
    scene.write(replicas=1)
    logs = (scene.paths.manager_log, scene.paths.proxy_log)
    for log in logs:
        log.touch()
        os.truncate(log, logfile.LIMIT_BYTES + 1)
    scene.start_manager()
    scene.wait(lambda: all(log.stat().st_size <= logfile.LIMIT_BYTES for log in logs))


def test_a_manager_steps_back_from_a_later_import_and_from_no_other(scene: Scene) -> None:
    """It ends no replica and starts no more.

    Above a later epoch of this machine's own it takes the next one: its folder lost what it wrote
    last, and replicas ignore leases of an epoch before one that they know.
    """
    scene.write(replicas=2)
    heard = scene.paths.folder / "heard"
    heard.write_text(str(TERM - 2))
    process = scene.start_manager()
    scene.wait(lambda: scene.whole(2))

    def epochs() -> set[int]:
        membership, signed = scene.store.membership(), cache.read(scene.paths.announcements)
        assert membership is not None
        return {
            membership.epoch,
            read_epoch(scene.paths),
            *(read_body(one).generation for one in signed),
        }

    scene.wait(lambda: epochs() == {TERM - 1})
    disk.write_whole(heard, str(TERM).encode())
    assert process.wait(30) == 1
    assert not scene.paths.manager_start.exists()
    with pytest.raises(PoolBusy, match="imported on another later"):
        scene.store.identity()
    assert len(list(scene.cloud.folder.glob("*.json"))) == 2
    assert scene.start_manager().wait(30) == 1


def test_no_certificate_is_issued_while_no_thread_can_be_started(scene: Scene) -> None:
    """Each tick tries to launch; status says why none succeeds, until one does."""
    scene.write(replicas=1)
    with on_a_thread(scene):
        with no_more():
            scene.wait(lambda: any("TasksMax" in n for n in scene.status().get("notes", [])))
            issued = Ledger(scene.paths.credentials).entries()
            assert Role.REPLICA not in {entry.holder.role for entry in issued}
        scene.wait(lambda: scene.running() == ["0.1"])


def test_a_tick_that_fails_keeps_no_lease_from_the_replicas(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a full disk, where a launch fails for days."""

    def full(self: Reconciler) -> None:
        raise StateError("no space left")

    monkeypatch.setattr(Reconciler, "tick", full)
    scene.write(replicas=1)
    with on_a_thread(scene):
        scene.wait(scene.paths.announcements.exists)


def test_an_up_beside_a_manager_whose_pool_is_just_over_has_a_manager(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It finds one at work and starts none: that one goes on with the hours that it was given."""
    monkeypatch.setenv("FOGFT_HOME", str(scene.home))
    scene.write(replicas=1, max_hours=2)
    scene.let_hours_pass(2)
    end, ups = teardown.end_machines, list[bool]()

    def ended(*given: Any, **how: Any) -> None:
        end(*given, **how)
        if not ups:
            scene.write(replicas=1, max_hours=2)
            ups.append(startup.start_manager(scene.store))

    monkeypatch.setattr(teardown, "end_machines", ended)
    with on_a_thread(scene) as running:
        scene.wait(lambda: scene.running() or not running.is_alive())
        assert scene.running() == ["0.1"]
        assert ups == [False]
