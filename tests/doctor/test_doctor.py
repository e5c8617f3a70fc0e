"""What the doctor says of things that are wrong, and how it says it."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from fogft import disk
from fogft.cli import main
from fogft.cloud.local import faults
from fogft.cloud.local.faults import CloudFaults
from fogft.doctor import checks, finding, machine, pools, ros
from fogft.doctor.finding import Finding, Situation, Verdict, fail, ok, warn
from fogft.model.replica import LinkReport, LinkState, ReplicaId
from fogft.pool.commands.status import Seen
from fogft.pool.credentials import authority
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.manager.status import ReplicaStatus, TopicStatus
from fogft.ros import environment, vendors
from tests.fakes.pools import FILE, STATUS, alive, lay_down, report
from tests.needs import needs

UID = "0123456789abcdef"


def situation(home: Path, *names: str, now: float | None = None) -> Situation:
    return Situation(home, names, None, time.time() if now is None else now)


def the_only(found) -> Finding:
    (only,) = found
    return only


def of_check(name: str, home: Path) -> Finding:
    """Return what a check says of the pool `planner`."""
    found = pools.processes(situation(home, "planner"))
    return the_only(one for one in found if one.check == name)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A pool's credentials: its CA and a robot's."""
    path = PoolPaths.of("planner", tmp_path).credentials
    path.parent.mkdir(parents=True)
    authority.create_authority(path, UID)
    issued = authority.issue(path, f"robot.r.1.{UID}", role=authority.Role.ROBOT)
    authority.write(issued, path, "robot")
    return path


# --- its text


def test_each_check_is_told_when_it_begins(monkeypatch, tmp_path):
    """A check of ROS takes seconds: what a pool reported since is not from the future."""
    monkeypatch.setenv("FOGFT_HOME", str(tmp_path))
    clock = iter(range(100, 200))
    monkeypatch.setattr(time, "time", lambda: float(next(clock)))
    told: list[float] = []
    monkeypatch.setattr(checks, "ALL", (lambda situation: told.append(situation.now) or (),) * 3)
    assert list(checks.examine()) == []
    assert told == sorted(set(told))


def test_a_finding_is_a_line_and_its_advice_another(monkeypatch, capsys):
    findings = [ok("clock", "2026-11-21"), warn("ports", "7448 is taken", "free it")]
    monkeypatch.setattr(checks, "examine", lambda _: iter(findings))
    assert main.run(["doctor"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "ok    clock               2026-11-21",
        "warn  ports               7448 is taken",
        "                          -> free it",
    ]


def test_it_fails_when_something_does_not_work(monkeypatch, capsys):
    findings = [ok("a", "fine"), warn("b", "odd", "look"), fail("c", "broken", "mend")]
    monkeypatch.setattr(checks, "examine", lambda _: iter(findings))
    assert main.run(["doctor"]) == 1
    said = capsys.readouterr()
    assert said.err == "\n3 checks: 1 failed, 1 warning\n"
    assert len(said.out.splitlines()) == 5
    assert "\033" not in said.out


def test_warnings_alone_are_no_failure(monkeypatch, capsys):
    monkeypatch.setattr(checks, "examine", lambda _: iter([warn("b", "odd", "look")]))
    assert main.run(["doctor", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == [
        {"check": "b", "verdict": "warn", "text": "odd", "advice": "look"}
    ]


def test_a_check_that_breaks_does_not_hide_the_others(monkeypatch, tmp_path):
    def breaks(_: Situation):
        raise RuntimeError("oh")

    monkeypatch.setenv("FOGFT_HOME", str(tmp_path))
    monkeypatch.setattr(checks, "ALL", (breaks, machine.clock))
    found = list(checks.examine())
    assert [f.verdict for f in found] == [Verdict.FAIL, Verdict.OK]
    assert "RuntimeError: oh" in found[0].text
    assert "unless processes" in found[0].advice, "a machine that is full is no bug of ours"


def test_whatever_is_wrong_comes_with_advice(tmp_path):
    """Every finding but `ok` says what to do."""
    light = [check for check in checks.ALL if check not in (ros.rclpy, ros.discovery)]
    here = situation(tmp_path, "no-such-pool")
    for found in (found for check in light for found in finding.run(check, here)):
        assert found.text
        assert bool(found.advice) == (found.verdict is not Verdict.OK), found


def test_a_pool_file_with_a_mistake_is_an_error(tmp_path, capsys):
    (tmp_path / "pool.yaml").write_text("run: x\n")
    assert main.run(["doctor", str(tmp_path / "pool.yaml")]) == 1
    assert capsys.readouterr().err.startswith("error: ")


# --- the machine


def test_a_clock_from_before_the_installation_is_wrong(tmp_path):
    assert the_only(machine.clock(situation(tmp_path, now=1e9))).verdict is Verdict.FAIL
    assert the_only(machine.clock(situation(tmp_path))).verdict is Verdict.OK


@needs("not-root")
def test_a_state_folder_that_cannot_be_written_is_found(tmp_path):
    tmp_path.chmod(0o500)
    assert the_only(machine.state_folder(situation(tmp_path / "x"))).verdict is Verdict.FAIL


def test_a_state_folder_that_others_read_is_found(tmp_path):
    tmp_path.chmod(0o755)
    first, _ = machine.state_folder(situation(tmp_path))
    assert (first.verdict, first.advice) == (Verdict.WARN, f"run `chmod 700 {tmp_path}`")


# --- ROS


@pytest.mark.parametrize(
    ("environ", "domain", "reach"),
    [
        ({}, Verdict.OK, Verdict.OK),
        ({"ROS_DOMAIN_ID": "42"}, Verdict.OK, Verdict.OK),
        ({"ROS_DOMAIN_ID": " 5"}, Verdict.OK, Verdict.OK),
        ({"ROS_DOMAIN_ID": "150"}, Verdict.WARN, Verdict.OK),
        ({"ROS_DOMAIN_ID": "233"}, Verdict.FAIL, Verdict.OK),
        ({"ROS_DOMAIN_ID": "-1"}, Verdict.FAIL, Verdict.OK),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, Verdict.OK, Verdict.FAIL),
        (
            {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", "ROS_STATIC_PEERS": "10.0.0.1"},
            Verdict.OK,
            Verdict.FAIL,
        ),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "NEAR"}, Verdict.OK, Verdict.FAIL),
        ({"ROS_LOCALHOST_ONLY": "1"}, Verdict.OK, Verdict.WARN),
        ({"ROS_LOCALHOST_ONLY": "0"}, Verdict.OK, Verdict.OK),
        (
            {"ROS_LOCALHOST_ONLY": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"},
            Verdict.OK,
            Verdict.WARN,
        ),
    ],
)
def test_the_domain_and_the_range_are_judged(tmp_path, environ, domain, reach):
    found = ros.domain(situation(tmp_path), environ)
    assert [f.verdict for f in found] == [domain, reach]


def test_a_profile_that_is_no_xml_is_found(tmp_path, monkeypatch):
    broken = tmp_path / "profile.xml"
    broken.write_text("<dds>")
    monkeypatch.setenv(environment.profile_variable(), str(broken))
    assert the_only(ros.profile(situation(tmp_path))).verdict is Verdict.FAIL


@pytest.mark.parametrize(
    ("rmw", "verdict", "said"),
    [
        ("rmw_fastrtps_cpp", Verdict.OK, "fogft is measured with"),
        ("rmw_cyclonedds_cpp", Verdict.WARN, "service calls between it and Fast DDS"),
        ("rmw_zenoh_cpp", Verdict.WARN, "rmw: zenoh"),
        ("rmw_connextdds", Verdict.WARN, "not tested"),
    ],
)
def test_the_middleware_is_named_with_what_is_known_of_it(rmw, verdict, said):
    found = ros.judge_middleware(rmw)
    assert found.verdict is verdict
    assert rmw in found.text
    assert said in found.text


def test_clients_without_answers_and_topics_that_nobody_hears_are_told():
    trouble = vendors.of_others("/plan", ["/mine"])  # with what to do
    service = replace(STATUS.services[0], counters={"trouble": trouble})
    topics = (TopicStatus("/scan", "sensor_msgs/msg/LaserScan", "robot"),)
    status = replace(STATUS, services=(service,), topics=topics)
    found = list(pools.judge_traffic("p", Seen(status, 0.0, manager_alive=True, answers=True)))
    assert [(one.check, one.verdict) for one in found] == [
        ("services", Verdict.FAIL),
        ("topics", Verdict.WARN),
    ]
    assert (found[0].text, found[0].advice) == (f"pool `p`: {trouble}", "")


@pytest.mark.parametrize(
    ("segment_bytes", "ours", "verdict"),
    [
        (35_131_392, "", Verdict.OK),
        (35_131_392, "/fogft/profile.xml", Verdict.WARN),
        (549_408, "", Verdict.WARN),
        (549_408, "/fogft/profile.xml", Verdict.WARN),
        (0, "", Verdict.OK),
    ],
)
def test_the_profile_is_judged_by_the_segment_that_is_mapped(segment_bytes, ours, verdict):
    assert ros.judge_segment(segment_bytes, "A_VARIABLE", ours).verdict is verdict


@pytest.mark.ros
def test_two_processes_find_each_other(tmp_path, monkeypatch, ros_domain):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    found = the_only(ros.discovery(situation(tmp_path)))
    assert found.verdict is Verdict.OK, found
    assert "was discovered in" in found.text


@pytest.mark.ros
def test_what_was_found_is_told_though_taking_the_node_down_crashes(
    tmp_path, monkeypatch, ros_domain
):
    crash = (
        "import os, sys; from rclpy.node import Node; from fogft.ros import self_test\n"
        "if sys.argv[1] == 'ask': Node.destroy_node = lambda _: os.kill(os.getpid(), 11)\n"
        "sys.exit(self_test.main(sys.argv[1:]))\n"
    )
    monkeypatch.setattr(ros, "child_command", lambda *words: [sys.executable, "-c", crash, *words])
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    found = the_only(ros.discovery(situation(tmp_path)))
    assert found.verdict is Verdict.OK, found


@pytest.mark.ros
def test_nodes_that_cannot_find_each_other_are_found_out(tmp_path, monkeypatch, ros_domain):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    found = the_only(ros.discovery(situation(tmp_path)))
    assert found.verdict is Verdict.FAIL
    assert found.text == "two nodes on this machine do not discover each other"


def test_without_rclpy_it_says_how_to_get_it(tmp_path, monkeypatch):
    broken = tmp_path / "rclpy"
    broken.mkdir()
    (broken / "__init__.py").write_text("raise ImportError('librcl.so: not found')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    found = the_only(ros.rclpy(situation(tmp_path)))
    assert found.verdict is Verdict.FAIL
    assert found.text == "ROS 2 cannot be used from this Python: librcl.so: not found"
    assert "`pip install 'fogft[ros]'` in a virtual environment" in found.advice


# --- pools


def test_good_credentials_are_good(folder, tmp_path):
    found = the_only(pools.certificates(situation(tmp_path, "planner")))
    assert found == ok("credentials", "pool `planner`: 2 certificates valid, keys private")


def test_a_key_that_others_can_read_is_found(folder, tmp_path):
    (folder / "robot.key").chmod(0o644)
    found = the_only(pools.certificates(situation(tmp_path, "planner")))
    assert found.verdict is Verdict.FAIL
    assert found.advice == f"run `chmod 600 {folder / 'robot.key'}`"


@pytest.mark.parametrize(
    ("days", "verdict", "words"),
    [(336, Verdict.WARN, "expires at"), (366, Verdict.FAIL, "expired at")],
)
def test_certificates_out_of_time_are_found(folder, days, verdict, words):
    now = time.time() + days * 86_400
    own = pools.certificates(situation(folder.parents[2], "planner", now=now))
    assert the_only(own).verdict is verdict
    joined = folder.parents[2] / "joined" / "planner.robot.ada"
    joined.parent.mkdir()
    folder.rename(joined)
    found = the_only(pools.certificates(situation(joined.parents[1], now=now)))
    assert found.verdict is verdict
    assert words in found.text
    assert "`fogft credentials issue robot ada`" in found.advice


def test_a_damaged_certificate_is_found(folder):
    (folder / "robot.crt").write_text("no certificate")
    found = the_only(pools.certificates(situation(folder.parents[2], "planner")))
    assert found.verdict is Verdict.FAIL


def test_missing_processes_are_found_and_living_ones_seen(tmp_path):
    paths = lay_down(tmp_path)
    manager, proxy = pools.processes(situation(tmp_path, "planner"))
    assert (manager.verdict, proxy.verdict) == (Verdict.WARN, Verdict.FAIL)
    assert "nothing is replaced" in manager.text
    assert proxy.advice == f"run `fogft up {FILE}`", "what works in this state"
    with disk.locked(paths.manager_lock):
        _, proxy, *_ = pools.processes(situation(tmp_path, "planner"))
    assert proxy.advice.startswith("the manager restarts it")
    with alive(paths):
        found = list(pools.processes(situation(tmp_path, "planner")))
    judged = {f.check: f.verdict for f in found if f.check not in ("links", "replicas")}
    assert judged == dict.fromkeys(("manager", "client proxy", "answers"), Verdict.OK)


def test_a_doctor_says_of_answers_what_status_says(tmp_path):
    """No replica that is up: the pool does not answer, though all of its processes run."""
    gone = replace(STATUS, replicas=[replace(one, link="suspect") for one in STATUS.replicas])
    paths = lay_down(tmp_path, gone)
    with alive(paths):
        answers = of_check("answers", tmp_path)
        assert (answers.verdict, answers.text) == (
            Verdict.FAIL,
            "pool `planner`: no replica answers `/plan`",
        )
        report(paths, gone, age_s=30)
        assert of_check("answers", tmp_path).verdict is Verdict.WARN


def test_a_client_proxy_that_was_killed_is_not_said_to_hang(tmp_path):
    paths = lay_down(tmp_path, STATUS)
    with alive(paths):
        report(paths, STATUS)
        written = disk.read_json(paths.proxy_status)
        disk.write_json(paths.proxy_status, {**written, "pid": 1 << 30})
        found = of_check("links", tmp_path)
    assert found.verdict is Verdict.FAIL
    assert "ended" in found.text
    assert "kill" not in found.advice


def test_a_full_disk_is_found_and_no_process_is_blamed_for_it(tmp_path, monkeypatch):
    paths = lay_down(tmp_path, STATUS)
    with alive(paths):
        report(paths, STATUS, age_s=30)
        assert of_check("links", tmp_path).verdict is Verdict.FAIL
        monkeypatch.setattr(disk, "unwritable", lambda folder: "full")
        found = of_check("disk", tmp_path)
        assert (found.verdict, found.text) == (
            Verdict.FAIL,
            f"pool `planner`: the disk of `{paths.folder}` is full",
        )
        every = pools.processes(situation(tmp_path, "planner"))
        assert "links" not in {one.check for one in every}


def judged_links(*links: LinkReport, phase: str = "ready") -> list[Finding]:
    rows = [ReplicaStatus(one.id.slot, one.id.generation, phase) for one in links]
    status = replace(STATUS, replicas=rows).joined(None, proxy_alive=True, links=links)
    return list(pools.judge_links("p", Seen(status, 0.0, manager_alive=True)))


def test_silent_links_are_found():
    silent = LinkReport(ReplicaId(UID, 1, 2), LinkState.SUSPECT)
    up = LinkReport(ReplicaId(UID, 0, 1), LinkState.UP)
    assert [f.verdict for f in judged_links(up)] == [Verdict.OK]
    found = judged_links(up, silent)
    assert [f.verdict for f in found] == [Verdict.WARN, Verdict.OK]
    assert "`1.2` is suspect: it does not answer probes" in found[0].text
    assert [f.verdict for f in judged_links(silent)] == [Verdict.WARN, Verdict.FAIL]


def test_a_replica_whose_program_ends_is_found():
    ends = LinkReport(ReplicaId(UID, 1, 2), LinkState.UP, detail="`run` exited with status 3")
    found = judged_links(ends, phase="starting")
    assert [f.verdict for f in found] == [Verdict.WARN, Verdict.OK]
    assert "`1.2` is not ready: `run` exited with status 3" in found[0].text
    assert "`fogft logs 1`" in found[0].advice


@pytest.mark.parametrize("phase", ["ready", "draining"])
def test_an_uplink_that_is_down_is_told_of_and_its_replica_is_not_called_unready(phase):
    down = LinkReport(ReplicaId(UID, 1, 2), LinkState.UP, detail="uplink `wlan0`: unreachable")
    found = judged_links(down, phase=phase)
    assert [f.verdict for f in found] == [Verdict.WARN, Verdict.OK]
    assert found[0].text.endswith("`1.2`: uplink `wlan0`: unreachable")


def test_chaos_that_lasts_is_found(tmp_path):
    assert list(pools.chaos(situation(tmp_path))) == []
    outage = CloudFaults({"local/us-west-2": None, "local/us-west-1": 1.0}, {"local/us-east-1": 0})
    (tmp_path / "local").mkdir()
    faults.write(tmp_path / "local" / faults.FILE, outage)
    found = the_only(pools.chaos(situation(tmp_path)))
    assert "outage in `local/us-west-2`, `local/us-east-1` has room for 0 machines" in found.text
    assert "us-west-1" not in found.text


def test_a_proxy_that_hangs_is_found(tmp_path):
    paths = lay_down(tmp_path)
    report = {"pid": 4711, "written_at": time.time() - 60, "links": []}
    paths.proxy_status.write_text(json.dumps(report))
    with disk.locked(paths.proxy_lock):
        found = of_check("links", tmp_path)
        paths.proxy_status.write_text("{torn")
        damaged = of_check("links", tmp_path)
    assert (found.verdict, damaged.verdict) == (Verdict.FAIL, Verdict.FAIL)
    assert "4711" in found.advice
