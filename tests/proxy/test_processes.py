"""Real `fogft serve` and `fogft proxy` processes, with an ordinary service beneath."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fogft import disk
from fogft.ros import environment
from tests.cloud.fake_metadata import serving
from tests.link.freezing import freeze
from tests.needs import BEFORE, needs
from tests.proxy.by_hand import LIMIT_S, ROOT, Caller, Parts, Replica, Robot, wait_for

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
environment.prepare(os.environ)


@pytest.fixture
def parts(tmp_path: Path, ros_domains: Callable[[], int]) -> Iterator[Parts]:
    made = Parts(tmp_path, ros_domains)
    yield made
    made.close()


@pytest.fixture
def call() -> Iterator[Callable[[Robot], Caller]]:
    """Make a caller beside a robot's proxy, and wait until it is answered."""
    made: list[Caller] = []

    def start(robot: Robot) -> Caller:
        made.append(Caller(robot.domain))
        made[-1].wait()
        return made[-1]

    yield start
    for caller in made:
        caller.close()


def test_a_robot_and_its_replicas_lose_nothing_whoever_of_them_ends(parts, call):
    """What may happen to one pool of processes, one after the other, under load."""
    replicas = [parts.replica(0), parts.replica(1)]
    robot = parts.robot("robot", *replicas)
    caller = call(robot)
    wait_for(lambda: robot.ready() == [0, 1], "both replicas")
    a_burst_is_answered_in_full(robot, replicas, caller)
    a_frozen_robot_does_not_hold_up_a_live_one(parts, robot, replicas[1], caller, call)
    a_proxy_starts_again_without_a_manager(robot, caller)
    a_proxy_that_is_told_to_end_hands_over(robot, caller)
    a_killed_proxy_is_replaced_by_the_one_in_line(parts, robot, caller)
    last = parts.replica(2, 0.02)
    a_membership_change_loses_nothing(robot, replicas[1], last, caller)
    what_a_dying_command_worked_on_is_answered_by_the_next(robot, last, caller)


def a_burst_is_answered_in_full(robot, replicas, caller):
    """The service's queue of ten, the default, loses none of them, with two replicas or one."""
    for _ in range(2):
        caller.ask(200)
        assert caller.all_answered()
    robot.follow(replicas[1])
    caller.ask(200)
    assert caller.all_answered()


def a_frozen_robot_does_not_hold_up_a_live_one(parts, live, replica, caller, call):
    """Two robots share a replica; one stops with requests under way, and goes on later."""
    frozen = parts.robot("frozen", replica)
    other = call(frozen)
    wait_for(lambda: live.ready() == [1], "the one that both have")
    before = live.links()[0]["reopened"]
    other.ask(50)
    freeze(frozen.process.pid)
    for _ in range(200):
        caller.ask()
        caller.spin(0.005)
    assert caller.all_answered()
    assert live.news()["links"][0]["reopened"] == before
    os.kill(frozen.process.pid, signal.SIGCONT)
    assert other.all_answered()
    frozen.process.kill()


def a_proxy_starts_again_without_a_manager(robot, caller):
    """Its configuration and the last membership on disk are all that it needs."""
    robot.restart()
    wait_for(robot.ready, "the replica")
    caller.wait()
    caller.ask(50)
    assert caller.all_answered()


def a_proxy_that_is_told_to_end_hands_over(robot, caller):
    """The standby serves before the old one leaves; twice, under load."""
    for _ in range(2):
        leaving, robot.process = robot.process, robot.start_standby()
        caller.ask(20)
        leaving.terminate()
        while leaving.poll() is None:
            caller.ask()
            caller.spin(0.01)
        caller.ask(20)
        assert caller.all_answered()
        assert leaving.returncode == 0
    wait_for(lambda: robot.report()["pid"] == robot.process.pid, "the standby's report")


def a_killed_proxy_is_replaced_by_the_one_in_line(parts, robot, caller):
    """It serves under the same name; ROS knows at once that the first is gone, not by its lease.

    A third is refused: one works, one waits.
    """
    for _ in range(2):
        standby = robot.start_standby()
        assert parts.start("proxy", robot.config, {}, "--standby").wait(LIMIT_S) == 1
        wait_for(lambda: robot.report().get("participant"), "its id in DDS")
        wait_for(lambda: caller.servers() == 1, "the end of the leases of those killed before")
        robot.process.kill()
        robot.process.wait()
        caller.wait()
        wait_for(lambda: caller.servers() == 1, "word of its end, long before its lease", 10.0)
        robot.process = standby
        wait_for(lambda: robot.report()["pid"] == robot.process.pid, "the standby's report")
        caller.ask(50)
        assert caller.all_answered()


def a_membership_change_loses_nothing(robot, old, new, caller):
    """A replica is exchanged for another while requests flow, then the old one dies."""

    def load_until(ready: list[int]) -> None:
        end = time.monotonic() + LIMIT_S
        while robot.ready() != ready:
            assert time.monotonic() < end, f"{ready} are never ready"
            caller.ask()
            caller.spin(0.01)

    robot.follow(old, new)
    load_until([old.id.slot, new.id.slot])
    caller.ask(20)
    robot.follow(new)
    load_until([new.id.slot])
    old.process.kill()
    caller.ask(20)
    assert caller.all_answered()


def what_a_dying_command_worked_on_is_answered_by_the_next(robot, replica, caller):
    """With one replica there is nobody else: the requests wait for the command's restart."""
    caller.ask(30)
    caller.spin(0.1)
    os.kill(first := replica.run_pid(), signal.SIGKILL)
    assert caller.all_answered()
    assert replica.run_pid() != first
    wait_for(lambda: robot.links()[0]["restarts"] == 1, "the restart in the report")


@needs("night")
def test_client_proxies_that_were_stopped_for_long_begin_anew(parts, call):
    """DDS may have forgotten them: the standby joins anew and takes over; the last starts anew."""
    replica = parts.replica(0)
    robot = parts.robot("robot", replica)
    caller = call(robot)

    def stop_for_long(*pids: int) -> None:
        for number, seconds in ((signal.SIGSTOP, 25.0), (signal.SIGCONT, 0.0)):
            for pid in (*pids, replica.process.pid):
                os.kill(pid, number)
            time.sleep(seconds)

    def works_again() -> None:
        wait_for(lambda: robot.report().get("pid") == robot.process.pid, "its report")
        caller.wait()
        caller.ask(50)
        assert caller.all_answered()

    standby = robot.start_standby()
    stop_for_long(robot.process.pid, standby.pid)
    assert robot.process.wait(LIMIT_S) == 1
    log = robot.config.with_suffix(".log")
    assert "handed over to its standby" in log.read_text()
    robot.process = standby
    assert replica.log.read_text().count("services_ready") == 2
    works_again()
    starts = log.read_text().count("proxy_started")
    stop_for_long(robot.process.pid)
    wait_for(lambda: log.read_text().count("proxy_started") > starts, "its start")
    works_again()
    assert robot.process.poll() is None


def test_deadly_requests_and_notices_cost_no_others_answer(parts, call):
    """Three replicas: a request kills each one's service, then two of them are told to go."""
    nowhere = {
        "AWS_EC2_METADATA_SERVICE_ENDPOINT": "http://127.0.0.1:1/",
        "GCE_METADATA_HOST": "127.0.0.1:1",
    }
    with serving("aws") as metadata:
        told = parts.replica(0, AWS_EC2_METADATA_SERVICE_ENDPOINT=f"http://{metadata.address}/")
        ended = parts.replica(1, **nowhere)
        robot = parts.robot("robot", told, ended, parts.replica(2))
        wait_for(lambda: robot.ready() == [0, 1, 2], "all replicas")
        caller = call(robot)
        requests_that_kill_the_service_harm_only_themselves(robot, caller)
        a_machine_that_is_told_of_its_end_gets_no_more_requests(robot, caller, told, metadata)
    a_machines_sigterm_is_a_notice(robot, caller, ended)
    line = killed_proxies_are_replaced_by_copies_of_the_spare(parts, robot, caller)
    proxies_end_when_their_folder_is_gone(parts, line)


def requests_that_kill_the_service_harm_only_themselves(robot, caller):
    """Two of them among a flow: each is tried once more, alone, and nothing else is lost.

    The first is at every idle replica when it kills; the second never at all three.
    """
    for _ in range(2):
        for _ in range(20):
            caller.ask()
            caller.spin(0.02)
        caller.poison()
        for _ in range(60):
            caller.ask()
            caller.spin(0.02)
        assert caller.all_answered(), robot.told()
        wait_for(lambda: robot.ready() == [0, 1, 2], "all to be back")
    report = robot.news()
    assert report["services"]["/plan"]["poison"] == 2
    assert report["services"]["/plan"]["silent"] == 0
    deaths = sum(link["restarts"] for link in report["links"])
    assert deaths <= (3 + 1) + (2 + 1)  # the copies of each, and then alone


def a_machine_that_is_told_of_its_end_gets_no_more_requests(robot, caller, told, metadata):
    """The metadata server's words reach the robot, which asks the others; none is lost.

    A rebalance is a hint: the replica is marked, and goes on answering.
    """
    metadata.rebalance = {"noticeTime": "2026-01-01T00:00:00Z"}
    wait_for(lambda: robot.links()[0]["at_risk"], "the hint")
    assert not robot.links()[0]["draining"]
    assert not robot.links()[1]["at_risk"]

    caller.ask(20)
    metadata.action = {"action": "terminate", "time": "2026-01-01T00:02:00Z"}
    wait_for(lambda: robot.links()[0]["draining"], "the notice")
    assert caller.all_answered()
    freeze(told.process.pid)  # whoever is asked now, it is not this one
    caller.ask(100)
    assert caller.all_answered()
    assert robot.news()["links"][0]["in_flight"] == 0


def a_machines_sigterm_is_a_notice(robot, caller, ended):
    """Where no cloud gives notice: what is under way is answered, then it ends."""
    caller.ask(20)
    ended.process.send_signal(signal.SIGTERM)
    wait_for(lambda: robot.links()[1]["draining"], "the notice")
    caller.ask(100)
    assert caller.all_answered()
    assert ended.process.wait(LIMIT_S) == 0


def killed_proxies_are_replaced_by_copies_of_the_spare(parts, robot, caller):
    """One after the other, with one start for all; return who is in line at the end."""
    works = robot.config.with_suffix(".lock")
    stands_by = disk.standby_lock(works)
    locks = works, stands_by, disk.standby_lock(stands_by)
    parts.start("proxy", robot.config, {}, "--spare")

    def line() -> list[int]:
        found = [disk.holder(lock) for lock in locks]
        return [pid for pid in found if pid] if len({*found, None}) == len(locks) + 1 else []

    for _ in range(3):
        os.kill(wait_for(line, "three in line")[0], signal.SIGKILL)
        caller.wait()
        caller.ask(20)
        assert caller.all_answered()
    return wait_for(line, "three in line")


def proxies_end_when_their_folder_is_gone(parts, line):
    """Who removes a pool's folder by hand leaves no process behind."""
    gone = parts.folder.rename(parts.folder.with_name("gone"))
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in line), "their end")
    gone.rename(parts.folder)


def test_a_spare_process_takes_over_when_the_one_at_work_dies(parts, call):
    """What was open is answered by it: it ran before, and was started no second time."""
    replica = Replica(parts, 0, 0.02, {}, extra="spare: true\n")
    robot = parts.robot("robot", replica)
    caller = call(robot)
    log = replica.log
    at_work, spare = wait_for(
        lambda: (
            len(pids := re.findall(r"run_started pid=(\d+)", log.read_text())) == 2
            and map(int, pids)
        ),
        "both in the log, in their order",
    )
    caller.ask(30)
    caller.spin(0.1)
    os.kill(at_work, signal.SIGKILL)
    assert caller.all_answered()
    assert log.read_text().count("spare_takes_over") == 1
    wait_for(lambda: len(replica.run_pids()) == 2, "another spare one")
    assert spare in replica.run_pids()
    replica.process.terminate()
    replica.process.wait(30)
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in (at_work, spare)), "the end")


@needs("history")
def test_a_robot_and_a_replica_one_minor_version_apart_work_together(parts, call):
    """The version before is taken out of the history: 0.2.0, the first that others stay true to."""
    before = parts.folder / "before"
    before.mkdir()
    archive = subprocess.run(
        ["git", "archive", BEFORE, "fogft", "templates"], cwd=ROOT, check=True, capture_output=True
    )
    subprocess.run(["tar", "-x"], cwd=before, input=archive.stdout, check=True)
    new_replica = parts.replica(1)
    parts.tree = before
    old_replica, old_robot = parts.replica(0), parts.robot("old", new_replica)
    parts.tree = ROOT
    new_robot = parts.robot("new", old_replica)
    for robot in (old_robot, new_robot):
        caller = call(robot)
        caller.ask(200)
        assert caller.all_answered()
