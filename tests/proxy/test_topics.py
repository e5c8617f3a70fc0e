"""Both sides of topics, joined by a link that loses, repeats and delays."""

from __future__ import annotations

import os
import random
import threading
from dataclasses import replace
from itertools import product
from typing import Any

import pytest

from fogft.errors import Unreadable
from fogft.link.port import Answer
from fogft.model.refusal import Refusal
from fogft.model.topic import Origin, Select, TopicSpec
from fogft.proxy.replica.topics import HOLD_S, TopicsOnReplica
from fogft.proxy.robot.topics import TopicsOnRobot
from fogft.requests.load import Handling
from fogft.topics.frames import (
    NO_SESSION,
    decode_batch,
    encode_batch,
    encode_message,
    encode_pull,
)
from tests.fakes.proxy import Clock, FakeLink
from tests.nightly import by_day

JUNK = b"junk"


class FakeTopics:
    """A node: what it publishes is kept, and the test says what it hears."""

    def __init__(self) -> None:
        self.published: dict[str, list[bytes]] = {}
        self.heard: dict[str, object] = {}
        self.mismatch = ""

    def publisher(self, topic):
        node, name = self, topic.name
        said = self.published.setdefault(name, [])

        class Publisher:
            def check(self, payload):
                if payload == JUNK:
                    raise Unreadable("junk")

            def publish(self, payload):
                said.append(payload)

            def subscribers(self):
                return 1

            def mismatch(self):
                return node.mismatch

            def close(self):
                node.published.pop(name, None)

        return Publisher()

    def subscribe(self, topic, on_message):
        self.heard[topic.name] = on_message
        return self.publisher(replace(topic, name="unused"))


class Carried:
    """A request on its way."""

    def __init__(self, world, slot, link, offered) -> None:
        self.service, self.request_id, self.payload, self.remaining_s = offered
        self.robot, self.handling, self._world, self._slot, self._link = (
            "r",
            Handling.NORMAL,
            world,
            slot,
            link,
        )
        self.ended = False

    def reply(self, payload: bytes, **_: Any) -> None:
        self._end(Answer(self.request_id, payload=payload, service=self.service))

    def refuse(self, reason: Refusal, **_: Any) -> None:
        self._end(Answer(self.request_id, refusal=reason, service=self.service))

    def _end(self, answer: Answer) -> None:
        if not self.ended:
            self.ended = True
            self._world.answers.append((self._slot, answer))


class World:
    """One robot, some replicas, and what is under way between them; driven by hand."""

    def __init__(self, topic: TopicSpec, replicas: int = 1) -> None:
        self.clock = Clock()
        self.topic = topic
        self.robot_node = FakeTopics()
        self.robot = TopicsOnRobot(lambda: None, clock=self.clock)
        self.robot.serve([topic], self.robot_node)
        self.nodes = [FakeTopics() for _ in range(replicas)]
        self.replicas = [TopicsOnReplica([topic], self.clock) for _ in range(replicas)]
        for one, node in zip(self.replicas, self.nodes, strict=True):
            one.use(node)
        self.links = [FakeLink(slot) for slot in range(replicas)]
        self.sent = [0] * replicas
        self.answers: list[tuple[int, Answer]] = []
        for link in self.links:
            link.ready = frozenset({topic.key_name})
        self.route()

    def route(self) -> None:
        self.robot.route({slot + 1: link for slot, link in enumerate(self.links)})

    def carry(self, lose=lambda: False) -> None:
        """Bring everything that is under way to its end, or lose it."""
        self.robot.tick()
        for slot, link in enumerate(self.links):
            broken = False  # a connection that breaks loses all that comes after
            for offered in link.offered[self.sent[slot] :]:
                self.sent[slot] += 1
                request = Carried(self, slot, link, offered)
                broken = broken or lose()
                if broken:
                    request.refuse(Refusal.LOST)
                    continue
                self.replicas[slot].request(request)
                self.publish_all(slot)
                if lose():  # it arrived, but nobody hears of it
                    self._drop(request)
        while self.answers:
            slot, answer = self.answers.pop(0)
            self.robot.answered(slot + 1, answer)

    def _drop(self, request: Carried) -> None:
        self.answers = [(s, a) for s, a in self.answers if a.request_id != request.request_id]
        request.ended = False
        request.refuse(Refusal.LOST)

    def publish_all(self, slot: int) -> None:
        """Do what the replica's thread does, here."""
        for inbox in self.replicas[slot].inboxes:
            inbox.close()
            inbox.run()


@pytest.fixture(autouse=True)
def no_threads(monkeypatch):
    monkeypatch.setattr("threading.Thread.start", lambda self: None)


TO = TopicSpec("/to", "p/msg/T", Origin.ROBOT, depth=100)
BACK = TopicSpec("/back", "p/msg/T", Origin.REPLICAS, depth=100)


@pytest.mark.parametrize("seed", range(by_day(6, at_night=200)))
def test_every_message_reaches_every_replica_once_and_in_order(seed):
    """Also over links that lose a third of what goes either way."""
    source = random.Random(seed)
    world = World(TO, replicas=2)
    said = [b"m%03d" % number for number in range(60)]
    for message in said:
        world.robot_node.heard["/to"](message)
        world.carry(lambda: source.random() < 0.33)
    for _ in range(200):
        world.clock.now += 1
        world.carry()
    for node in world.nodes:
        assert node.published["/to"] == said
    assert world.robot.report()["/to"]["passed"] == len(said)


def test_the_rate_is_that_of_the_last_seconds_and_what_goes_nowhere_is_counted():
    world = World(TO, replicas=0)
    for _ in range(4):
        for _ in range(5):
            world.robot_node.heard["/to"](b"m")
        world.clock.now += 1.0
        world.carry()
    counted = world.robot.report()["/to"]
    assert counted["rate_hz"] == 5.0
    assert (counted["messages"], counted["passed"], counted["dropped"]) == (20, 0, 20)
    for _ in range(8):
        world.clock.now += 1.0
        world.carry()
    assert world.robot.report()["/to"]["rate_hz"] == 0.0


def test_what_a_replica_no_longer_has_is_counted_as_dropped():
    world = World(replace(BACK, depth=1))
    for said in ((b"1",), (b"2", b"3", b"4")):
        world.carry()
        world.carry()
        for message in said:
            world.nodes[0].heard["/back"](message)
    world.carry()
    world.carry()
    assert world.robot_node.published["/back"] == [b"1", b"2", b"4"]
    assert world.robot.report()["/back"]["dropped"] == 1


@pytest.mark.parametrize("seed", range(by_day(6, at_night=200)))
def test_every_message_of_a_replica_comes_back_once_and_in_order(seed):
    source = random.Random(seed)
    world = World(BACK)
    said = [b"m%03d" % number for number in range(60)]
    world.carry()
    world.carry()
    for message in said:
        world.nodes[0].heard["/back"](message)
        world.clock.now += source.random()
        world.replicas[0].tick()
        world.carry(lambda: source.random() < 0.33)
    for _ in range(10):
        world.clock.now += HOLD_S
        world.replicas[0].tick()
        world.carry()
    assert world.robot_node.published["/back"] == said


def test_only_the_leader_is_asked_and_another_one_when_it_is_silent_or_gone():
    """What the others say would be dropped, so it is not sent; nor passed later, as old news."""
    world = World(BACK, replicas=2)
    both = range(2)

    def say(slots, message) -> list[bytes]:
        for slot in slots:
            world.nodes[slot].heard["/back"](message)
        before = len(world.robot_node.published["/back"])
        for _ in range(3):
            world.carry()
        return world.robot_node.published["/back"][before:]

    for _ in range(3):
        world.carry()
    for number in range(10):
        world.clock.now += 0.1
        assert say(both, b"m%d" % number) == [b"m%d" % number]
    counted = world.robot.report()["/back"]
    assert counted["dropped"] <= 1  # of the pull that was out when nobody led
    assert counted["passed"] == 10
    follower = 1  # the first answers first
    world.clock.now += 0.5
    assert say([follower], b"while the leader is quiet") == []
    world.clock.now += 1.0
    assert say([], b"") == []  # it is asked from now on
    assert say([follower], b"now") == [b"now"]
    world.links.pop(follower)
    world.route()
    assert say([0], b"old") == []
    assert say([0], b"new") == [b"new"]


def test_a_pull_is_held_until_there_is_something_and_not_for_ever():
    world = World(BACK)
    world.carry()  # where to begin
    world.carry()
    out = len(world.links[0].offered)
    world.carry()
    assert len(world.links[0].offered) == out
    world.clock.now += HOLD_S
    world.replicas[0].tick()
    world.carry()
    world.carry()
    assert len(world.links[0].offered) == out + 1


def test_a_robot_that_pulls_without_end_has_only_its_own_pulls_answered_early():
    world = World(BACK)
    for _ in range(2):
        world.carry()
    for number in range(200):
        offered = (BACK.key_name, b"%016d" % number, world.links[0].offered[-1][2], 10.0)
        greedy = Carried(world, 0, world.links[0], offered)
        greedy.robot = "eve"
        world.replicas[0].request(greedy)
    world.publish_all(0)
    ours = world.links[0].offered[-1][1]
    assert len(world.answers) > 100
    assert ours not in {answer.request_id for _, answer in world.answers}


def pulled_by(world: World, payload: bytes) -> Carried:
    made = Carried(world, 0, world.links[0], (BACK.key_name, os.urandom(16), payload, 10.0))
    world.replicas[0].request(made)
    return made


def test_an_answer_that_fails_ends_no_other():
    world = World(BACK)
    failing, other = [pulled_by(world, encode_pull(NO_SESSION, 0)) for _ in range(2)]
    failing.reply = lambda *_, **__: 1 / 0
    world.publish_all(0)
    assert [answer.request_id for _, answer in world.answers] == [other.request_id]


def test_two_proxies_of_one_robot_hear_all():
    world = World(BACK)
    pulled_by(world, encode_pull(NO_SESSION, 0))
    world.publish_all(0)
    session, _, _ = decode_batch(world.answers.pop()[1].payload)
    for number in range(1, 51):
        world.nodes[0].heard["/back"](b"%d" % number)
        for every in (1, 5):
            if number % every == 0:
                pulled_by(world, encode_pull(session, number - every))
                world.publish_all(0)
                assert decode_batch(world.answers.pop()[1].payload)[1] == number
        world.clock.now += 0.05


def test_who_pulls_the_same_again_and_again_has_it_copied_once_in_a_while():
    world = World(BACK)
    for _ in range(2):
        world.carry()
    world.nodes[0].heard["/back"](b"m")
    pull = world.links[0].offered[-1][2]
    greedy = [
        Carried(world, 0, world.links[0], (BACK.key_name, os.urandom(16), pull, 10.0))
        for _ in range(20)
    ]
    for one in greedy:
        one.robot = "eve"
        world.replicas[0].request(one)
    world.publish_all(0)
    ends = [a.refusal for _, a in world.answers if a.request_id in {o.request_id for o in greedy}]
    assert sorted(map(str, ends)) == sorted(2 * ["None"] + 18 * ["overloaded"])
    world.carry()
    assert world.robot_node.published["/back"] == [b"m"]


def asked_by(world: World, robot: str, number: int, size: int) -> Carried:
    payload = encode_message(robot.encode().ljust(8), number, bytes(size))
    made = Carried(world, 0, world.links[0], (TO.key_name, os.urandom(16), payload, 10.0))
    made.robot = robot
    world.replicas[0].request(made)
    return made


@pytest.mark.parametrize(("size", "count"), [(10, 1036), (8 << 20, 12)])
def test_what_waits_to_be_published_is_bounded_and_one_robot_cannot_have_all_of_it(size, count):
    """What was refused comes again, and nothing after it is published before."""
    world = World(TO)
    eves = [asked_by(world, "eve", number, size) for number in range(1, count)]
    assert 0 < sum(one.ended for one in eves) < len(eves)
    ours = asked_by(world, "ann", 1, size)
    assert not ours.ended
    refused = min(number for number, one in enumerate(eves, 1) if one.ended)
    world.publish_all(0)
    assert {answer.refusal for _, answer in world.answers} == {None, Refusal.OVERLOADED}
    published = len(world.nodes[0].published["/to"])
    assert published < len(eves)
    world.answers.clear()
    later = asked_by(world, "eve", count, 1)
    world.clock.now += 0.21
    again = asked_by(world, "eve", refused, 1)
    world.publish_all(0)
    ends = {answer.request_id: answer.refusal for _, answer in world.answers}
    assert ends == {later.request_id: Refusal.OVERLOADED, again.request_id: None}
    assert len(world.nodes[0].published["/to"]) == published + 1


@pytest.mark.parametrize("depth", [1, 100])
@pytest.mark.parametrize("reliable", [False, True])
def test_a_topic_flows_again_at_once_after_a_replica_could_not_publish(reliable, depth):
    """However few messages the robot keeps, and whether it sends any again."""
    world = World(replace(TO, reliable=reliable, depth=depth))
    node = world.nodes[0]
    world.replicas[0].use(None)
    said = [b"%02d" % number for number in range(40)]
    for number, message in enumerate(said):
        if number == 10:
            world.replicas[0].use(node)
        world.robot_node.heard["/to"](message)
        world.carry()
        world.clock.now += 0.05
    for _ in range(20):
        world.clock.now += 0.05
        world.carry()
    published = node.published["/to"]
    assert published == sorted(published)
    assert set(said[35:]) <= set(published)
    if depth > 1 and reliable:
        assert published == said


def test_while_messages_are_under_way_none_overtakes_them_by_a_new_connection():
    world = World(TO)
    say, link = world.robot_node.heard["/to"], world.links[0]
    say(b"one")
    before = link.offer
    link.offer = lambda *words, **named: before(*words, **named)
    say(b"two")
    assert len(link.offered) == 1
    world.carry()
    world.carry()
    assert world.nodes[0].published["/to"] == [b"one", b"two"]


def test_who_comes_later_gets_what_is_latched_and_nothing_else():
    for latched, wanted in ((True, [b"two", b"three"]), (False, [])):
        world = World(TopicSpec("/to", "p/msg/T", Origin.ROBOT, depth=2, latched=latched))
        link = world.links.pop()
        world.route()
        for message in (b"one", b"two", b"three"):
            world.robot_node.heard["/to"](message)
        world.links.append(link)
        world.route()
        world.carry()
        assert world.nodes[0].published["/to"] == wanted


@pytest.mark.parametrize("latched", [True, False])
def test_a_command_that_starts_anew_gets_what_robots_latched(latched):
    """It leaves ROS and comes back; the robot has sent it, and does so only once."""
    world = World(TopicSpec("/to", "p/msg/T", Origin.ROBOT, depth=2, latched=latched))
    for message in (b"one", b"two", b"three"):
        world.robot_node.heard["/to"](message)
        world.carry()
    world.replicas[0].use(None)
    world.replicas[0].use(node := FakeTopics())
    world.robot_node.heard["/to"](b"four")
    world.carry()
    assert node.published["/to"] == ([b"two", b"three"] if latched else []) + [b"four"]


def test_what_is_kept_for_late_replicas_is_bounded_by_bytes(monkeypatch):
    monkeypatch.setattr("fogft.topics.queues.Ring.kept_bytes", 1000)
    world = World(TopicSpec("/to", "p/msg/T", Origin.ROBOT, depth=100, latched=True))
    link = world.links.pop()
    world.route()
    said = [b"%0100d" % number for number in range(50)]
    for message in said:
        world.robot_node.heard["/to"](message)
    world.links.append(link)
    world.route()
    world.carry()
    assert world.nodes[0].published["/to"] == said[-10:]


def test_a_robot_that_comes_later_gets_what_a_replica_latched():
    world = World(TopicSpec("/back", "p/msg/T", Origin.REPLICAS, depth=1, latched=True))
    for message in (b"old", b"new"):
        world.nodes[0].heard["/back"](message)
    world.carry()
    world.carry()
    assert world.robot_node.published["/back"] == [b"new"]


def test_a_replica_that_starts_anew_begins_a_new_session():
    world = World(BACK)
    world.carry()
    world.carry()
    world.nodes[0].heard["/back"](b"before")
    world.carry()
    world.replicas[0], world.nodes[0] = TopicsOnReplica([BACK], world.clock), FakeTopics()
    world.replicas[0].use(world.nodes[0])
    for out in list(world.links[0].offered[-1:]):
        world.robot.answered(1, Answer(out[1], refusal=Refusal.LOST, service=out[0]))
    world.carry()  # is told where to begin
    world.clock.now += 1
    world.carry()
    world.nodes[0].heard["/back"](b"after")
    world.carry()
    assert world.robot_node.published["/back"] == [b"before", b"after"]


def test_a_probe_is_answered_while_topics_are_being_made(monkeypatch):
    """The wire's thread asks what is ready; a pool may have a thousand topics to make."""
    monkeypatch.undo()  # with threads
    node, first_made, go_on = FakeTopics(), threading.Event(), threading.Event()
    replica = TopicsOnReplica([TO, TopicSpec("/second", TO.type, TO.origin)])
    make = node.publisher

    def publisher(topic):
        made = make(topic)
        if topic.name == "/second":
            first_made.set()
            go_on.wait(10.0)
        else:
            made.subscribers = lambda: go_on.set() or using.join(10.0) or 1
        return made

    node.publisher = publisher
    using = threading.Thread(target=replica.use, args=(node,))
    using.start()
    first_made.wait(10.0)
    assert replica.ready() == {TO.key_name}
    replica.close()


def test_noise_from_a_peer_harms_nobody():
    world = World(TO)
    request = Carried(world, 0, world.links[0], ("topic /to", b"i" * 16, b"noise", 5.0))
    world.replicas[0].request(request)
    world.publish_all(0)
    assert [answer.refusal for _, answer in world.answers] == [Refusal.MALFORMED]
    back = World(BACK)
    request = Carried(back, 0, back.links[0], ("topic /back", b"i" * 16, b"noise", 5.0))
    back.replicas[0].request(request)
    back.publish_all(0)
    assert back.answers[0][1].refusal == Refusal.MALFORMED
    back.answers.clear()
    back.robot.tick()
    id = back.links[0].offered[-1][1]
    back.robot.answered(1, Answer(id, payload=b"noise", service="topic /back"))
    back.clock.now += 1
    back.robot.tick()
    assert len(back.links[0].offered) == 2


@pytest.mark.parametrize("select", list(Select))
def test_what_is_no_message_neither_leads_nor_passes_and_is_held_against_its_replica(select):
    """The others' messages pass as if it were not there."""
    topic = TopicSpec("/back", "p/msg/T", Origin.REPLICAS, select=select, depth=100)
    world = World(topic, replicas=2)
    world.robot = TopicsOnRobot(lambda: None, lambda said: b"+".join(said.values()), world.clock)
    world.robot.serve([topic], world.robot_node)
    world.route()
    for _ in range(2):
        world.carry()
    said = [b"head%016d" % number for number in range(10**8, 10**9, 10**8)]
    for slot, messages in enumerate(([JUNK] * 4, said)):
        for message in messages:
            world.clock.now += 0.3
            world.nodes[slot].heard["/back"](message)
            world.carry()
    assert world.robot_node.published["/back"] == said
    assert [world.robot.misreads(key) for key in (1, 2)] == [True, False]
    assert world.robot.report()["/back"]["refused"] == 4


def test_a_replica_that_answers_at_once_with_nothing_is_not_asked_again_at_once():
    """It would keep the client proxy busy for nothing."""
    world = World(BACK)
    link = world.links[0]
    for turn in range(100):
        world.robot.tick()
        id, session = link.offered[-1][1], bytes([turn % 2] * 8)
        nothing = encode_batch(session, 0, ())
        world.robot.answered(1, Answer(id, payload=nothing, service=BACK.key_name))
        world.clock.now += 0.01
    assert len(link.offered) < 10


def test_a_publisher_that_is_not_heard_is_told_of(caplog):
    """Otherwise nothing would pass, and nobody would know why."""
    for topic, side in product((TO, BACK), ("robot_node", "nodes")):
        world = World(topic)
        node = getattr(world, side)
        (node[0] if side == "nodes" else node).mismatch = "offers best effort"
        for _ in range(3):
            world.clock.now += 3
            world.robot.tick()
            world.replicas[0].tick()
        told = world.replicas[0].trouble or world.robot.report()[topic.name].get("trouble")
        assert told == "offers best effort"
    assert len([r for r in caplog.records if "best effort" in r.getMessage()]) == 4


def test_what_a_command_did_wrong_is_not_told_instead_of_its_end():
    world = World(TO)
    world.nodes[0].mismatch = "asks for reliable messages"
    world.clock.now += 3
    world.replicas[0].tick()
    assert world.replicas[0].trouble
    world.replicas[0].use(None)
    assert world.replicas[0].trouble == ""
