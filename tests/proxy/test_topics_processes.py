"""Topics and an action between a real client proxy and real replicas, with ordinary nodes."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fogft.model.plain import to_plain
from fogft.model.topic import ActionSpec, Origin, TopicSpec
from fogft.poolfile.pool import action_services, action_topics
from fogft.ros import environment
from tests.needs import needs
from tests.proxy.by_hand import Parts, Replica, Robot
from tests.ros.nodes.person import Person

pytestmark = [pytest.mark.ros, pytest.mark.timeout(240), needs("test_msgs")]
environment.prepare(os.environ)
FIBONACCI = "test_msgs/action/Fibonacci"
STRING = "std_msgs/msg/String"
COUNT = ActionSpec("/count", FIBONACCI, 30.0, 100.0)
PASSED = (
    TopicSpec("/words", STRING, Origin.ROBOT, depth=100),
    TopicSpec("/map", STRING, Origin.ROBOT, depth=1, latched=True),
    TopicSpec("/echo", STRING, Origin.REPLICAS, depth=100),
    *action_topics(COUNT),
)
SERVICES = action_services(COUNT)
EXTRA = f"topics: {json.dumps([to_plain(topic) for topic in PASSED])}\n"
NODE = Path(__file__).parent / "nodes" / "acting_node.py"


@pytest.fixture
def parts(tmp_path: Path, ros_domains: Callable[[], int]) -> Iterator[Parts]:
    services = json.dumps([to_plain(service) for service in SERVICES])
    made = Parts(tmp_path, ros_domains, services=services, node=NODE)
    yield made
    made.close()


class Fog:
    """Replicas with different speeds, one robot, and somebody who uses it."""

    def __init__(self, parts: Parts) -> None:
        self.parts = parts
        self.replicas: list[Replica] = []
        self.robot: Robot | None = None

    def add(self, slot: int, step_s: float) -> Replica:
        note = self.parts.folder / f"note{slot}"
        note.touch()
        replica = Replica(self.parts, slot, f"{note} {step_s}", {}, extra=EXTRA)
        self.replicas.append(replica)
        if self.robot is not None:
            self.robot.follow(*self.replicas)
        return replica

    def noted(self, slot: int, word: str) -> list[str]:
        """Return what a replica's node has written after a word."""
        lines = (self.parts.folder / f"note{slot}").read_text().splitlines()
        return [line.partition(" ")[2] for line in lines if line.startswith(word + " ")]

    def ready(self, *slots: int) -> bool:
        """Whether all that passes does so with these replicas."""
        assert self.robot is not None
        every = len(PASSED) + len(SERVICES)
        links = {link["slot"]: link for link in self.robot.links()}
        return all(len(links.get(slot, {}).get("ready", ())) == every for slot in slots)


@pytest.fixture
def fog(parts: Parts) -> Fog:
    return Fog(parts)


@pytest.fixture
def person(fog: Fog) -> Iterator[Person]:
    fog.add(0, 0.05)
    fog.robot = Robot(fog.parts, "robot", tuple(fog.replicas), EXTRA)
    made = Person(fog.robot.domain)
    yield made
    made.close()


def test_topics_and_an_action_pass_and_outlive_their_replicas(fog, person):
    """On two replicas, which are then killed, and on a third one that comes in their place."""
    slow = fog.add(1, 0.5)
    person.wait(lambda: fog.ready(0, 1), "both replicas")
    check_topics(fog, person)
    client = check_goals(fog, person)

    goal = send(client, person, 30)
    result = goal.get_result_async()
    id = bytes(goal.goal_id.uuid).hex()
    person.wait(lambda: id in fog.noted(0, "begun"), "the goal")
    for replica in (fog.replicas[0], slow):
        replica.process.kill()
    fog.replicas.clear()
    fog.add(2, 0.01)
    person.wait(result.done, "the result of who came later")
    assert result.result().status == 4
    assert fog.noted(2, "done") == [id]
    person.wait(lambda: fog.noted(2, "map") == ["of the house"], "what is latched, there too")


def test_a_client_proxy_that_is_told_to_end_hands_an_action_over(fog, person):
    """A goal that it gave has its result, those made meanwhile are accepted, and have theirs.

    Who is behind may never be given a goal that the other has already accepted.
    """
    from rclpy.action import ActionClient
    from test_msgs.action import Fibonacci

    fog.add(1, 0.1)
    person.wait(lambda: fog.ready(0, 1), "both replicas")
    client = ActionClient(person.node, Fibonacci, "/count")
    person.wait(client.server_is_ready, "the action")
    leaving, fog.robot.process = fog.robot.process, fog.robot.start_standby()
    goals = [send(client, person, 40)]
    results = [goals[0].get_result_async()]
    leaving.terminate()
    while leaving.poll() is None or len(goals) < 5:
        goals.append(send(client, person, 5))
        results.append(goals[-1].get_result_async())
    assert leaving.returncode == 0
    goals.append(send(client, person, 5))
    results.append(goals[-1].get_result_async())
    for result in results:
        person.wait(result.done, "the result")
        assert result.result().status == 4
    begun = [fog.noted(slot, "begun") for slot in (0, 1)]
    assert all(len(ids) == len(set(ids)) for ids in begun), "no goal twice at a replica"
    assert {*begun[0], *begun[1]} == {bytes(goal.goal_id.uuid).hex() for goal in goals}


def check_topics(fog: Fog, person: Person) -> None:
    """Every message reaches every replica, and what they all say is heard once, in order."""
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import String

    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    person.node.create_publisher(String, "/map", latched).publish(String(data="of the house"))
    words = person.node.create_publisher(String, "/words", 100)
    heard: list[str] = []
    person.node.create_subscription(String, "/echo", lambda m: heard.append(m.data), 100)
    person.wait(lambda: words.get_subscription_count() == 1, "the proxy's subscription")
    person.wait(lambda: person.node.count_publishers("/echo") == 1, "the proxy's publisher")
    said = [str(number) for number in range(50)]
    for word in said:
        words.publish(String(data=word))
    for slot in (0, 1):
        person.wait(lambda slot=slot: fog.noted(slot, "heard") == said, f"the words at {slot}")
        person.wait(lambda slot=slot: fog.noted(slot, "map"), f"the map at {slot}")
    person.wait(lambda: said[-1] in heard, "the echo")
    assert heard == said


def send(client, person: Person, order: int, feedback: Callable[[Any], None] | None = None) -> Any:
    """Send a goal; return its handle once it is accepted."""
    from test_msgs.action import Fibonacci

    future = client.send_goal_async(Fibonacci.Goal(order=order), feedback_callback=feedback)
    person.wait(future.done, "the goal's acceptance")
    assert future.result().accepted
    return future.result()


def check_goals(fog: Fog, person: Person) -> Any:
    """The first result, feedback of one replica at a time, losers that stop, cancel for all."""
    from rclpy.action import ActionClient
    from test_msgs.action import Fibonacci

    client = ActionClient(person.node, Fibonacci, "/count")
    person.wait(client.server_is_ready, "the action")
    told: list[int] = []
    goal = send(client, person, 10, lambda m: told.append(len(m.feedback.sequence)))
    id = bytes(goal.goal_id.uuid).hex()
    result = goal.get_result_async()
    person.wait(result.done, "the result")
    assert result.result().status == 4
    assert list(result.result().result.sequence)[-3:] == [34, 55, 89]
    assert told
    assert told == sorted(set(told))
    for slot in (0, 1):
        person.wait(lambda slot=slot: fog.noted(slot, "begun") == [id], f"the goal at {slot}")
    person.wait(lambda: fog.noted(1, "cancelled") == [id], "the loser to stop")

    goal = send(client, person, 1000)
    id = bytes(goal.goal_id.uuid).hex()
    result = goal.get_result_async()
    for slot in (0, 1):
        person.wait(lambda slot=slot: id in fog.noted(slot, "begun"), f"the goal at {slot}")
    cancelling = goal.cancel_goal_async()
    person.wait(cancelling.done, "the cancellation")
    assert len(cancelling.result().goals_canceling) == 1
    person.wait(result.done, "the cancelled goal's result")
    assert result.result().status == 5
    for slot in (0, 1):
        person.wait(lambda slot=slot: id in fog.noted(slot, "cancelled"), f"the end at {slot}")
    return client
