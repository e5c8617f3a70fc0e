"""Real processes: fair shares between robots, an interrupted loser, a fallback on the robot."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fogft.ros import environment
from tests.proxy.by_hand import ROOT, Parts, Replica, Robot, wait_for

pytestmark = [pytest.mark.ros, pytest.mark.timeout(240)]
environment.prepare(os.environ)

NODE = ROOT / "tests/proxy/nodes/gated_node.py"
SERVICES = (
    "[{name: /work, type: std_srvs/srv/SetBool, timeout_s: 120.0, cancel: /work_cancel,"
    " on_timeout: fallback, fallback_service: {name: /work_onboard, while_none_ready: true}}]"
)
SET_BOOL = "std_srvs/srv/SetBool"


@pytest.fixture
def parts(tmp_path: Path, ros_domains: Callable[[], int]) -> Iterator[Parts]:
    made = Parts(tmp_path, ros_domains, services=SERVICES, node=NODE)
    yield made
    made.close()


class Asking:
    """A robot's own nodes: one that asks, and its fallback on board."""

    def __init__(self, robot: Robot) -> None:
        from rclpy.serialization import deserialize_message, serialize_message
        from std_srvs.srv import SetBool

        from fogft.ros.node import SerialisedNode

        self.robot = robot
        self._bytes = {x: bytes(serialize_message(SetBool.Request(data=x))) for x in (True, False)}
        self._name_in = lambda p: str(deserialize_message(p, SetBool.Response).message)
        self.node = SerialisedNode("asking", robot.domain)
        onboard = bytes(serialize_message(SetBool.Response(success=True, message="onboard")))
        ends: list[Any] = []
        ends.append(
            self.node.serve("/work_onboard", SET_BOOL, lambda _, h: ends[0].respond(h, onboard))
        )
        self._client = self.node.client("/work", SET_BOOL)
        wait_for(self._client.available, "the service")

    def send(self, data: bool, count: int = 1) -> list[str]:
        """Ask so many times, all at once; return the list in which those who answer will be."""
        names: list[str] = []
        for _ in range(count):
            self._client.call(self._bytes[data], lambda p: names.append(self._name_in(p)))
        return names

    def first_answer(self) -> str:
        """Ask until an answer comes: discovery may know one way before the other."""
        asked = [self.send(True)]

        def answered() -> str:
            came = [name for names in asked for name in names]
            return came[0] if came else ""

        for _ in range(10):
            try:
                return str(wait_for(answered, "a first answer", 6.0))
            except AssertionError:
                asked.append(self.send(True))
        return ""

    def counters(self) -> dict[str, Any]:
        return dict(self.robot.report().get("services", {}).get("/work", {}))


def held(robot: Robot, slot: int) -> int:
    """Return how many requests a replica says that it holds."""
    found = [k["work"].get("held", 0) for k in robot.links() if k["slot"] == slot]
    return int(found[0]) if found else -1


def test_robots_share_fairly_losers_are_interrupted_and_the_robot_helps_itself(parts):
    """Ten of one robot wait, and one of another comes second; then a loser; then nobody is left."""
    gate, log = parts.folder / "gate", parts.folder / "log"
    gated: Replica = parts.replica(0, f"gated,{gate},{log}")
    chatty, modest = parts.robot("chatty", gated), parts.robot("modest", gated)
    for robot in (chatty, modest):
        wait_for(lambda robot=robot: robot.ready() == [0], "the replica")
    gate.touch()
    a, b = Asking(chatty), Asking(modest)
    try:
        assert {a.first_answer(), b.first_answer()} == {"gated"}
        wait_for(lambda: held(chatty, 0) == 0, "an idle replica")
        gate.unlink()
        log.write_text("")
        ten = a.send(True, 10)
        wait_for(lambda: held(chatty, 0) >= 10, "ten to wait at the replica")
        one = b.send(False)
        wait_for(lambda: held(chatty, 0) >= 11, "the other robot's, too")
        gate.touch()
        wait_for(lambda: len(ten) == 10 and len(one) == 1, "all answers")
        order = [line.split()[1] for line in log.read_text().splitlines()]
        assert order.count("True") >= 10
        assert order.index("False") <= 2, order

        gate.unlink()
        log.write_text("")
        free = parts.replica(1, f"free,{NODE},{log}.free")  # its gate is always open
        chatty.follow(gated, free)
        wait_for(lambda: chatty.ready() == [0, 1], "the second replica")
        answer = a.send(True)
        wait_for(lambda: answer, "an answer")
        assert answer == ["free"]
        wait_for(lambda: log.read_text() == "gated True stopped\n", "the loser to be interrupted")

        before = a.counters()["fallback"]
        for replica in (gated, free):
            replica.process.kill()
        wait_for(lambda: chatty.ready() == [], "nobody to be ready")
        answer = a.send(True)
        wait_for(lambda: answer, "the robot's own answer")
        assert answer == ["onboard"]
        wait_for(lambda: a.counters()["fallback"] == before + 1, "it to be counted")
    finally:
        for asking in (a, b):
            asking.node.close()
