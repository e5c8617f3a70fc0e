"""The three services of an action on the robot, hand-driven: one goal on all replicas."""

from __future__ import annotations

from typing import Any

from fogft.core.goals import cancel_request, goal_of
from fogft.core.spec_topics import action_services
from fogft.proxy.actions import Actions
from tests.proxy.fakes import Clock, FakeLink

GOAL, CANCEL, RESULT = action_services("/count", "p/action/T", 5.0, 60.0)
HEADER = b"\0\1\0\0"
ID = b"i" * 16
ACCEPTED, REFUSED = HEADER + b"\1", HEADER + b"\0"
UNKNOWN, SUCCEEDED, CANCELED, ABORTED = (HEADER + bytes([s]) for s in (0, 4, 5, 6))


class Scene:
    """An action, some replicas, and a client whose requests and answers the test sees."""

    def __init__(self, replicas: int = 2) -> None:
        self.clock = Clock()
        self.answers: list[tuple[Any, bytes]] = []
        actions = Actions()
        self.parts = {
            spec.part.value: actions.make(spec, self._answered, lambda: None)
            for spec in (GOAL, CANCEL, RESULT)
        }
        for part in self.parts.values():
            part._clock = self.clock
        self.links = [FakeLink(slot) for slot in range(replicas)]
        self.route(*self.links)

    def _answered(self, handle: Any, payload: bytes) -> None:
        self.answers.append((handle, payload))

    def route(self, *links: FakeLink) -> None:
        for part in self.parts.values():
            part.route(links)
        self.tick()

    def tick(self, seconds: float = 0.0) -> None:
        self.clock.now += seconds
        for part in self.parts.values():
            part.tick()

    def ask(self, part: str, payload: bytes) -> None:
        self.parts[part].submit(payload, part)

    def say(self, slot: int, payload: bytes, part: str) -> None:
        """Answer the last request of a part at a replica."""
        link = self.links[slot]
        name = self.parts[part].spec.name
        n = max(i for i, offered in enumerate(link.offered) if offered[0] == name)
        self.parts[part].answered(link, link.reply(payload, n))

    def given(self, link: FakeLink, part: str) -> list[bytes]:
        """Return the requests of a part that a replica was given."""
        return [
            payload for name, _, payload, _ in link.offered if name == self.parts[part].spec.name
        ]

    def accept(self) -> None:
        """Send a goal, have it accepted, and ask for its result."""
        self.ask("goal", HEADER + ID + b"5")
        self.say(0, ACCEPTED, "goal")
        self.ask("result", HEADER + ID)


def test_a_goal_reaches_every_replica_and_the_first_acceptance_counts():
    scene = Scene()
    scene.ask("goal", HEADER + ID + b"5")
    assert [scene.given(link, "goal") for link in scene.links] == [[HEADER + ID + b"5"]] * 2
    scene.say(1, REFUSED, "goal")
    assert scene.answers == []
    scene.say(0, ACCEPTED, "goal")
    assert scene.answers == [("goal", ACCEPTED)]
    assert all(link.forgotten == [] for link in scene.links)  # nobody is told to drop it


def test_a_goal_that_all_refuse_is_refused():
    scene = Scene()
    scene.ask("goal", HEADER + ID)
    scene.say(0, REFUSED, "goal")
    scene.say(1, REFUSED, "goal")
    assert scene.answers == [("goal", REFUSED)]


def test_the_first_success_is_the_result_and_the_others_cancel():
    scene = Scene(3)
    scene.accept()
    scene.say(1, ABORTED, "result")
    assert scene.answers == [("goal", ACCEPTED)]
    scene.say(2, SUCCEEDED, "result")
    assert scene.answers[1:] == [("result", SUCCEEDED)]
    scene.tick()
    assert [scene.given(link, "cancel") for link in scene.links] == [
        [cancel_request(ID)], [cancel_request(ID)], [],
    ]  # fmt: skip


def test_without_a_success_the_replicas_end_counts_when_none_is_left():
    """And what says nothing of the goal never stands before what does."""
    scene = Scene()
    scene.accept()
    scene.say(0, CANCELED, "result")
    assert len(scene.answers) == 1
    scene.say(1, CANCELED, "result")
    assert scene.answers[1:] == [("result", CANCELED)]
    scene.ask("result", HEADER + b"other goal id...")
    scene.say(0, CANCELED, "result")
    scene.say(1, UNKNOWN, "result")
    assert scene.answers[2:] == [("result", CANCELED)]


def test_a_cancellation_reaches_every_replica():
    scene = Scene()
    scene.accept()
    scene.ask("cancel", cancel_request(ID))
    assert [scene.given(link, "cancel") for link in scene.links] == [[cancel_request(ID)]] * 2
    cancelling = HEADER + b"\0\0\0\0" + b"\1\0\0\0"
    scene.say(1, cancelling, "cancel")
    assert scene.answers[1:] == [("cancel", cancelling)]
    assert all(link.forgotten == [] for link in scene.links)


def test_a_replica_that_comes_later_is_given_the_goal_and_asked_until_it_knows_it():
    scene = Scene(1)
    scene.accept()
    late = FakeLink(7)
    scene.links = [late]
    scene.route(late)  # and the first one is gone
    assert [goal_of(payload) for payload in scene.given(late, "goal")] == [ID]
    scene.say(0, UNKNOWN, "result")
    assert len(scene.answers) == 1
    scene.tick(1.0)
    assert len(scene.given(late, "result")) == 2
    scene.say(0, SUCCEEDED, "result")
    assert scene.answers[1:] == [("result", SUCCEEDED)]
    scene.route()
    scene.route(late)
    assert len(scene.given(late, "goal")) == 1  # it is over


def test_a_goal_whose_result_nobody_awaits_is_not_begun_anew():
    scene = Scene(1)
    scene.ask("goal", HEADER + ID)
    scene.say(0, ACCEPTED, "goal")
    late = FakeLink(7)
    scene.route(scene.links[0], late)
    assert scene.given(late, "goal") == []


def test_a_goal_ends_with_its_clients_patience():
    scene = Scene(1)
    scene.accept()
    scene.tick(61.0)
    late = FakeLink(7)
    scene.route(late)
    assert scene.given(late, "goal") == []
    assert len(scene.answers) == 1


def test_a_result_of_a_goal_that_nobody_knows_is_told_as_such():
    scene = Scene(1)
    scene.ask("result", HEADER + ID)
    scene.say(0, UNKNOWN, "result")
    assert scene.answers == [("result", UNKNOWN)]
