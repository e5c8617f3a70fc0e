"""Real proxies that find each other through a real rendezvous, while addresses and servers go."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fogft.model import membership
from fogft.model.credentials import CredentialPaths, Role
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.records.client import RendezvousClient
from fogft.records.record import RecordKind
from fogft.records.roster import admission_content
from fogft.ros import environment
from tests.needs import needs
from tests.ports import free_port
from tests.proxy.by_hand import UID, Caller, Parts, Replica, Robot, wait_for
from tests.records import certificate_names

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
environment.prepare(os.environ)

# Requests go on while no replica can answer: the service must not be withdrawn meanwhile.
SERVICES = "[{name: /plan, type: nav_msgs/srv/GetPlan, timeout_s: 45.0, advertise: once_ready}]"


def free_endpoint() -> str:
    return f"127.0.0.1:{free_port()}"


class Pool(Parts):
    """Robots and replicas that are told of nothing but a rendezvous; the test is the manager."""

    def __init__(self, folder: Path, domain: Callable[[], int]) -> None:
        super().__init__(folder, domain, services=SERVICES)
        self.meeting = free_endpoint()
        self.issue(certificate_names.rendezvous(UID, "a"), Role.RENDEZVOUS, "rendezvous")
        self.issue(certificate_names.manager(UID), Role.MANAGER, "manager")
        self._place = folder / "rendezvous.yaml"
        self._place.write_text(
            f'pool_uid: "{UID}"\nlisten: {self.meeting}\nrecords: place.json\n'
            "credentials: {ca: ca/ca.crt, certificate: rendezvous.crt, key: rendezvous.key}\n"
        )
        self.rendezvous = self.start("rendezvous", self._place)
        files = CredentialPaths(
            folder / "ca/ca.crt", folder / "manager.crt", folder / "manager.key"
        )
        self.manager = RendezvousClient([self.meeting], files, UID)
        self.manager.start()

    def kill_rendezvous(self) -> None:
        self.rendezvous.kill()
        self.rendezvous.wait()

    def start_rendezvous(self) -> None:
        self.rendezvous = self.start("rendezvous", self._place)

    def make_replica(self, slot: int, generation: int = 1, extra: str = "") -> Replica:
        meeting = f"rendezvous: ['{self.meeting}']\nrecords: r{slot}.{generation}.json\n"
        return Replica(self, slot, 0.001, {}, generation=generation, extra=meeting + extra)

    def make_robot(self, name: str, *, extra: str = "") -> Robot:
        meeting = f"rendezvous: ['{self.meeting}']\nrecords: {name}-records.json\n"
        return Robot(self, name, (), meeting + extra)

    def admit(self, *ids: tuple[int, int]) -> None:
        version = self.next_version()
        members = tuple(Member(ReplicaId(UID, *id), "") for id in ids)
        content = admission_content(Membership("p", UID, 1, version, members))
        self.manager.publish(RecordKind.ADMISSION, "", 1, content, sequence=version)

    def close(self) -> None:
        self.manager.close()
        super().close()


@pytest.fixture
def pool(tmp_path: Path, ros_domains: Callable[[], int]) -> Iterator[Pool]:
    made = Pool(tmp_path, ros_domains)
    yield made
    made.close()


@pytest.fixture
def call() -> Iterator[Callable[[Robot], Caller]]:
    made: list[Caller] = []

    def start(robot: Robot) -> Caller:
        made.append(Caller(robot.domain))
        made[-1].wait()
        return made[-1]

    yield start
    for caller in made:
        caller.close()


def load_until(caller: Caller, condition: Callable[[], object], limit_s: float = 60.0) -> None:
    """Ask and take answers until a condition holds."""
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end, "what was awaited under load never came"
        caller.ask()
        caller.spin(0.01)


def links_by_id(robot: Robot) -> dict[tuple[int, int], str]:
    return {(li["slot"], li["generation"]): li["state"] for li in robot.links() if li["ready"]}


@pytest.mark.parametrize("how", [pytest.param("kill", marks=needs("night")), "freeze"])
def test_who_is_where_is_learned_from_the_rendezvous_under_load(pool, call, how):
    """What may happen to two robots that nobody tells anything, one after the other."""
    robots, callers = a_second_robot_needs_no_manager_and_a_replica_moves(pool, call)
    no_request_fails_while_the_rendezvous_is_away(pool, robots[0], callers[0], how)
    the_managers_file_and_the_records_go_together(pool, robots[0], callers[0])


def a_second_robot_needs_no_manager_and_a_replica_moves(pool, call):
    """Two robots learn of a replica from its own record: its address is told to nobody else.

    It is launched again at another port, as the next generation; then a request that goes on
    the whole time finds it there, and neither robot was touched.
    """
    old = pool.make_replica(0, extra=f"advertise: {'127.0.0.1:1'}\n")
    pool.admit((0, 1))
    robots = [pool.make_robot(name) for name in ("ada", "bob")]
    wait_for(lambda: all("127.0.0.1:1" in str(r.links()) for r in robots), "the told address")
    old.process.kill()
    first = pool.make_replica(0, 2)  # not told its address: the rendezvous sees its host
    pool.admit((0, 2))
    callers = [call(robot) for robot in robots]
    pids = [robot.process.pid for robot in robots]
    moved = pool.make_replica(0, 3)
    pool.admit((0, 3))
    for robot, caller in zip(robots, callers, strict=True):
        load_until(caller, lambda robot=robot: links_by_id(robot) == {(0, 3): "up"})
    assert moved.endpoint != first.endpoint
    first.process.kill()
    for caller in callers:
        caller.ask(50)
        assert caller.all_answered()
    assert [robot.process.poll() for robot in robots] == [None, None]
    assert [robot.report()["pid"] for robot in robots] == pids
    robots[1].process.kill()
    return robots, callers


def no_request_fails_while_the_rendezvous_is_away(pool, robot, caller, how):
    """And what joins meanwhile is used once it is back, with the robot untouched."""

    def connected() -> bool:
        return robot.report()["records"]["rendezvous"][0]["connected"]

    if how == "kill":
        pool.kill_rendezvous()
    else:
        os.kill(pool.rendezvous.pid, signal.SIGSTOP)
    load_until(caller, lambda: not connected())
    pool.make_replica(1)
    pool.admit((0, 3), (1, 1))
    caller.ask(100)
    assert caller.all_answered()
    assert links_by_id(robot) == {(0, 3): "up"}
    if how == "kill":
        pool.start_rendezvous()
    else:
        os.kill(pool.rendezvous.pid, signal.SIGCONT)
    load_until(caller, lambda: links_by_id(robot) == {(0, 3): "up", (1, 1): "up"})
    assert caller.all_answered()


def the_managers_file_and_the_records_go_together(pool, robot, caller):
    """The later of both counts: a file of an older epoch or version moves nobody."""
    file = pool.folder / "ada-members.json"
    file.write_text(json.dumps(membership.to_dict(Membership("p", UID, 1, 2, ()))))
    caller.ask(20)
    assert caller.all_answered()
    assert sorted(link["slot"] for link in robot.news()["links"] if link["ready"]) == [0, 1]
    file.write_text(json.dumps(membership.to_dict(Membership("p", UID, 2, 1, ()))))
    wait_for(lambda: not robot.links(), "the later membership of the file")


def test_a_replica_that_cannot_be_reached_dials_out_to_every_robot(pool, call):
    """It listens on its own loopback only; its connections and its process die and come back.

    It was told of one robot's door alone: the other one's own record tells it where to dial.
    """
    pool.admit((0, 1))
    doors = [free_endpoint(), free_endpoint()]
    robots = [
        pool.make_robot(name, extra=f"dial_in: {door}\ndial_in_listen: {door}\n")
        for name, door in zip(("ada", "bob"), doors, strict=True)
    ]
    replica = pool.make_replica(0, extra=f"dial_out: ['{doors[0]}']\n")
    callers = [call(robot) for robot in robots]
    for robot, caller in zip(robots, callers, strict=True):
        caller.ask(100)
        assert caller.all_answered()
        assert robot.news()["door"]["tunnels"] >= 1
    replica.process.kill()
    callers[0].ask(5)
    pool.admit((0, 2))
    pool.make_replica(0, 2, extra=f"dial_out: ['{doors[0]}']\n")
    assert callers[0].all_answered()


def test_one_robot_and_its_manager_need_no_rendezvous_for_a_dialling_replica(
    tmp_path, ros_domains, call
):
    """The manager's file admits a replica without endpoint; replica and robot know the door."""
    parts = Parts(tmp_path, ros_domains)
    try:
        door = free_endpoint()
        replica = Replica(parts, 0, 0.001, {}, extra=f"dial_out: ['{door}']\n")
        replica.endpoint = ""
        robot = Robot(parts, "ada", (replica,), f"dial_in: {door}\ndial_in_listen: {door}\n")
        caller = call(robot)
        caller.ask(50)
        assert caller.all_answered()
    finally:
        parts.close()
