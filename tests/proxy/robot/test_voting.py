"""A dispatcher that believes a quorum, its links driven by hand; and a liar among processes."""

from __future__ import annotations

import operator
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fogft.errors import RosError
from fogft.model.choices import FallbackSpec
from fogft.model.refusal import Refusal
from fogft.model.spec import OnTimeout, ServiceSpec
from fogft.proxy.robot.dispatcher import Dispatcher
from fogft.proxy.robot.sending import key_of
from fogft.requests.votes import Quorum
from fogft.ros import environment
from tests.fakes.proxy import Clock, FakeClient, FakeLink
from tests.proxy.by_hand import LIMIT_S, ROOT, Parts, wait_for

pytestmark = pytest.mark.timeout(180)


def number(payload: bytes) -> float:
    try:
        return float(payload)
    except ValueError as error:
        raise RosError("no number") from error


class Scene:
    def __init__(self, links: int = 3, **spec: object) -> None:
        self.clock, self.responses = Clock(), []
        self.votes = Quorum(2, number, operator.eq)
        self.dispatcher = Dispatcher(
            ServiceSpec("/s", "std_srvs/srv/SetBool", timeout_s=5.0, quorum=2, **spec),
            lambda handle, payload: self.responses.append((handle, payload)),
            empty_response=b"empty",
            clock=self.clock,
            decide=self.votes,
        )
        self.links = [FakeLink(slot) for slot in range(links)]
        self.dispatcher.route(self.links)

    def answer(self, slot: int, payload: bytes) -> None:
        self.dispatcher.answered(self.links[slot], self.links[slot].reply(payload))


def test_two_that_agree_answer_whatever_came_first():
    scene = Scene()
    scene.dispatcher.submit(b"q", "h")
    scene.answer(2, b"9")
    scene.answer(0, b"7")
    assert not scene.responses
    scene.answer(1, b"7.0")
    assert scene.responses == [("h", b"7.0")]
    assert scene.dispatcher.report()["disagreed"] == {"2.1": 1}


def test_a_slow_liar_is_heard_out_and_flagged():
    scene = Scene()
    for number in range(3):
        scene.dispatcher.submit(b"q", number)
        scene.answer(0, b"7")
        scene.answer(1, b"7")
        assert not scene.links[2].forgotten
        scene.answer(2, b"9")
    assert scene.responses == [(n, b"7") for n in range(3)]
    assert [scene.dispatcher.disagrees(key_of(link)) for link in scene.links] == [
        False,
        False,
        True,
    ]


def test_fewer_replicas_than_must_agree_are_as_good_as_none():
    """The service is withdrawn, or its fallback asked at once. A flagged one does not count."""
    scene = Scene(1, fallback=FallbackSpec("/local", while_none_ready=True))
    local = FakeClient()
    scene.dispatcher.adopt(scene.dispatcher.spec, local)
    assert not scene.dispatcher.able
    scene.dispatcher.submit(b"q", "h")
    scene.dispatcher.tick()
    assert len(local.calls) == 1
    scene.links += [FakeLink(1), FakeLink(2)]
    for links, able in ((scene.links[:2], True), (scene.links[1:], True), (scene.links[2:], False)):
        scene.dispatcher.route(links)
        assert scene.dispatcher.able is able
    scene.votes.flagged.add(key_of(scene.links[2]))
    scene.dispatcher.route(scene.links[1:])
    assert not scene.dispatcher.able


def test_what_a_flagged_replica_answers_is_not_read():
    """It may be large, and take seconds."""
    scene = Scene()
    scene.votes.flagged.add(key_of(scene.links[2]))
    scene.dispatcher.submit(b"q", "h")
    scene.answer(2, b"noise")
    scene.answer(0, b"7")
    scene.answer(1, b"7")
    assert scene.responses == [("h", b"7")]
    assert not scene.dispatcher.report()["refused"]


@pytest.mark.parametrize("on_timeout", [OnTimeout.SILENT, OnTimeout.EMPTY])
def test_without_agreement_the_deadline_decides(on_timeout):
    scene = Scene(2, on_timeout=on_timeout)
    scene.dispatcher.submit(b"q", "h")
    scene.answer(0, b"7")
    scene.answer(1, b"9")
    for _ in range(60):
        scene.clock.now += 0.1
        scene.dispatcher.tick()
    assert scene.responses == ([("h", b"empty")] if on_timeout is OnTimeout.EMPTY else [])
    assert all(len(link.offered) == 1 for link in scene.links), "one replica has one vote"
    scene.answer(1, b"7")
    assert len(scene.responses) == (on_timeout is OnTimeout.EMPTY)


def test_a_third_replica_that_comes_decides():
    scene = Scene(2)
    scene.dispatcher.submit(b"q", "h")
    scene.answer(0, b"7")
    scene.answer(1, b"9")
    scene.links.append(FakeLink(2))
    scene.dispatcher.route(scene.links)
    scene.answer(2, b"7")
    assert scene.responses == [("h", b"7")]


def test_noise_and_refusals_are_no_ballots():
    scene = Scene()
    scene.dispatcher.submit(b"q", "h")
    scene.answer(0, b"noise")
    scene.dispatcher.answered(scene.links[1], scene.links[1].refusal(Refusal.CRASHED))
    scene.answer(2, b"7")
    assert not scene.responses
    assert scene.dispatcher.report()["refused"] == {"malformed": 1, "crashed": 1}


# -- processes ------------------------------------------------------------------------------

NODE = ROOT / "tests/proxy/nodes/judging_node.py"
SERVICES = "[{name: /judge, type: std_srvs/srv/SetBool, timeout_s: 20.0, quorum: 2}]"


@pytest.fixture
def parts(tmp_path: Path, ros_domains: Callable[[], int]) -> Iterator[Parts]:
    environment.prepare(os.environ)
    made = Parts(tmp_path, ros_domains, services=SERVICES, node=NODE)
    yield made
    made.close()


@pytest.mark.ros
def test_a_lying_replica_is_never_believed_and_is_reported(parts):
    """It is the fastest of three; every answer is right, and its link's report says so."""
    import threading

    from rclpy.serialization import deserialize_message, serialize_message
    from std_srvs.srv import SetBool

    from fogft.ros.node import SerialisedNode

    replicas = [parts.replica(0, "honest"), parts.replica(1, "honest"), parts.replica(2, "lies")]
    robot = parts.robot("robot", *replicas)
    wait_for(lambda: sorted(robot.ready()) == [0, 1, 2], "three replicas")
    node = SerialisedNode("asking", robot.domain)
    client = node.client("/judge", "std_srvs/srv/SetBool")
    wait_for(client.available, "the service")

    def ask(data: bool, limit_s: float) -> str | None:
        came, answer = threading.Event(), []
        client.call(
            bytes(serialize_message(SetBool.Request(data=data))),
            lambda payload: (answer.append(payload), came.set()),
        )
        if not came.wait(limit_s):
            return None
        return str(deserialize_message(answer[0], SetBool.Response).message)

    wait_for(lambda: ask(True, 1.0) is not None, "a first answer")
    right = [ask(data, LIMIT_S) for data in [True, False] * 10]
    node.close()
    assert right == ["yes", "no"] * 10
    wait_for(
        lambda: {k["slot"]: k["disagrees"] for k in robot.links()} == {0: False, 1: False, 2: True},
        "the liar to be reported",
    )
