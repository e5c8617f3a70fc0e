"""The three services of an action on the robot, hand-driven: one goal on all replicas."""

from __future__ import annotations

from typing import Any

import pytest

from fogft.model.spec import Part
from fogft.model.topic import ActionSpec
from fogft.poolfile.pool import action_services
from fogft.proxy.robot.actions import Actions
from fogft.topics.goals import REJECTED, cancel_request, goal_of, is_success
from tests.fakes.proxy import Clock, FakeLink

GOAL, CANCEL, RESULT = action_services(ActionSpec("/count", "p/action/T", 5.0, 60.0))
HEADER = b"\0\1\0\0"
ID = b"i" * 16
ACCEPTED, REFUSED = HEADER + b"\1", HEADER + b"\0"
UNKNOWN, SUCCEEDED, CANCELED, ABORTED = (HEADER + bytes([s]) for s in (0, 4, 5, 6))


class Scene:
    """An action, some replicas, and a client whose requests and answers the test sees."""

    def __init__(self, replicas: int = 2) -> None:
        self.clock = Clock()
        self.answers: list[tuple[Any, bytes]] = []
        actions = Actions(self.clock)
        self.parts = {
            spec.part.value: actions.make(spec, self._answered, lambda at=0.0: None)
            for spec in (GOAL, CANCEL, RESULT)
        }
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


@pytest.mark.parametrize("is_over", [False, True])
def test_another_goal_with_the_same_id_is_rejected_and_reaches_nobody(is_over: bool):
    """Its client would get the other one's result."""
    scene = Scene()
    scene.accept()
    if is_over:
        scene.say(0, SUCCEEDED, "result")
    scene.ask("goal", HEADER + ID + b"6")
    assert scene.answers[-1] == ("goal", REJECTED)
    assert not is_success(Part.GOAL, REJECTED)
    assert [scene.given(link, "goal") for link in scene.links] == [[HEADER + ID + b"5"]] * 2
    counts = scene.parts["goal"].report()
    assert (counts["received"], counts["answered"], counts["pending"]) == (2, 2, 0)


def test_of_all_that_are_cancelled_none_goes_to_a_replica_that_comes_later():
    """Also what only a later answer names, as the first replica had ended it already."""
    scene = Scene()
    for goal in (first := b"x" * 16, second := b"y" * 16):
        scene.ask("goal", HEADER + goal + b"5")
        for slot in (0, 1):
            scene.say(slot, ACCEPTED, "goal")
        scene.ask("result", HEADER + goal)
    scene.say(0, ABORTED, "result")
    scene.ask("cancel", HEADER + bytes(24))
    scene.say(0, cancelled(first), "cancel")
    scene.say(1, cancelled(first, second), "cancel")
    late = FakeLink(2)
    scene.route(*scene.links, late)
    scene.tick(1.0)
    assert scene.given(late, "goal") == []


def cancelled(*goals: bytes) -> bytes:
    """Return the answer to a cancellation of all."""
    info = b"".join(goal + bytes(8) for goal in goals)
    return HEADER + bytes(4) + len(goals).to_bytes(4, "little") + info


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


def latest(link: FakeLink, name: str) -> int:
    return max(i for i, offered in enumerate(link.offered) if offered[0] == name)


def crash(scene: Scene, slot: int = 0) -> None:
    """Its command dies, with the request for the result."""
    link = scene.links[slot]
    scene.parts["result"].answered(link, link.refusal("crashed", latest(link, RESULT.name)))


def test_a_newcomer_that_does_not_take_the_goal_now_is_given_it_again():
    """It is overloaded, or its window is full; then the first replica is gone."""
    scene = Scene(1)
    scene.accept()
    late = FakeLink(7)
    scene.links = [late]
    scene.route(late)
    refusal = late.refusal("overloaded", latest(late, GOAL.name))
    scene.parts["goal"].answered(late, refusal)
    scene.tick(1.0)
    assert len(scene.given(late, "goal")) == 2
    full = FakeLink(8, room=0)
    scene.links = [full]
    scene.route(full)
    full.room = 1000
    scene.tick(1.0)
    assert len(scene.given(full, "goal")) == 1
    scene.say(0, ACCEPTED, "goal")
    scene.say(0, SUCCEEDED, "result")
    assert scene.answers[1:] == [("result", SUCCEEDED)]


def test_a_replica_that_had_no_room_when_the_goal_was_made_is_given_it_later():
    scene = Scene(2)
    scene.links[1].room = 0
    scene.accept()
    assert scene.given(scene.links[1], "goal") == []
    scene.links[1].room = 1000
    scene.tick(1.0)
    assert scene.given(scene.links[1], "goal") == [HEADER + ID + b"5"]


def test_a_goal_whose_result_every_replica_has_dropped_is_told_as_such():
    """Not asked for again and again until the client's patience ends."""
    scene = Scene(2)
    scene.accept()
    scene.clock.now += 1.0
    scene.say(1, ACCEPTED, "goal")
    scene.say(0, UNKNOWN, "result")
    scene.say(1, UNKNOWN, "result")  # it may not have known the goal when it was asked
    assert len(scene.answers) == 1
    scene.tick(1.0)
    assert [len(scene.given(link, "result")) for link in scene.links] == [1, 2]
    scene.say(1, UNKNOWN, "result")
    assert scene.answers[1:] == [("result", UNKNOWN)]


def test_who_refused_the_goal_is_asked_once_and_who_comes_next_is_given_it():
    scene = Scene(1)
    scene.accept()
    busy, willing = FakeLink(7), FakeLink(8)
    scene.links = [busy]
    scene.route(busy)
    scene.say(0, REFUSED, "goal")
    for _ in range(20):
        scene.say(0, UNKNOWN, "result")
        scene.tick(1.0)
    assert len(scene.given(busy, "result")) == 1
    assert len(scene.given(busy, "goal")) == 1
    scene.links = [willing]
    scene.route(busy, willing)
    scene.say(0, ACCEPTED, "goal")
    scene.say(0, SUCCEEDED, "result")
    assert scene.answers[1:] == [("result", SUCCEEDED)]


def test_a_replica_whose_command_crashed_is_given_the_goal_again():
    """Its link has not even noticed."""
    scene = Scene(1)
    scene.accept()
    crash(scene)
    scene.tick(1.0)
    assert len(scene.given(scene.links[0], "goal")) == 2
    scene.say(0, ACCEPTED, "goal")
    scene.tick(1.0)
    scene.say(0, SUCCEEDED, "result")
    assert scene.answers[1:] == [("result", SUCCEEDED)]


def test_a_goal_that_nobody_took_in_time_leaves_nothing_behind():
    scene = Scene(1)
    scene.ask("goal", HEADER + ID)
    scene.tick(6.0)
    scene.ask("goal", HEADER + b"j" * 16)
    scene.say(0, REFUSED, "goal")
    assert scene.parts["goal"].report()["goals"] == 0


def test_a_replica_whose_command_crashed_often_is_asked_once_it_has_begun_anew():
    scene = Scene(1)
    scene.accept()
    for _ in range(4):
        crash(scene)
        scene.tick(1.0)
        scene.say(0, ACCEPTED, "goal")
        scene.tick(1.0)
    scene.say(0, SUCCEEDED, "result")
    assert scene.answers[1:] == [("result", SUCCEEDED)]


def test_a_replica_that_refused_and_comes_back_willing_is_asked_for_the_result():
    scene = Scene(2)
    scene.accept()
    scene.say(1, REFUSED, "goal")
    scene.say(1, UNKNOWN, "result")
    first, second = scene.links
    scene.route(first)
    scene.route(first, second)
    scene.say(1, ACCEPTED, "goal")
    scene.route(second)
    scene.tick(1.0)
    scene.say(1, SUCCEEDED, "result")
    assert scene.answers[1:] == [("result", SUCCEEDED)]


def cancelling(*ids: bytes) -> bytes:
    """Return a response that names these goals, as CDR has it."""
    return HEADER + b"\0\0\0\0" + bytes([len(ids), 0, 0, 0]) + b"".join(i + bytes(8) for i in ids)


def test_a_goal_that_was_cancelled_is_begun_on_nobody_else():
    """Neither on who had no room when it was made, nor on who comes later."""
    scene = Scene(2)
    scene.links[1].room = 0
    scene.accept()
    scene.ask("cancel", cancel_request(ID))
    scene.say(0, cancelling(b"other goal id...", ID), "cancel")
    scene.say(0, CANCELED, "result")
    scene.links[1].room = 1000
    late = FakeLink(7)
    scene.links.append(late)
    scene.route(*scene.links)
    scene.tick(10.0)
    for slot in (1, 2):
        assert scene.given(scene.links[slot], "goal") == []
        scene.say(slot, UNKNOWN, "result")
    assert scene.answers[-1] == ("result", CANCELED)


def test_a_replica_cancels_no_goal_but_the_one_that_it_is_told_to():
    """It keeps the order that ended a goal, and answers it with the next one, which others take."""
    scene, new = Scene(2), b"n" * 16
    scene.accept()
    scene.say(1, SUCCEEDED, "result")
    scene.tick()
    assert scene.given(scene.links[0], "cancel") == [cancel_request(ID)]
    scene.ask("goal", HEADER + new + b"5")
    scene.say(0, cancelling(ID, new), "cancel")
    scene.say(1, ACCEPTED, "goal")
    scene.ask("result", HEADER + new)
    scene.tick()
    assert cancel_request(new) not in scene.given(scene.links[1], "cancel")
    late = FakeLink(7)
    scene.links.append(late)
    scene.route(*scene.links)
    assert scene.given(late, "goal") == [HEADER + new + b"5"]


def test_who_takes_a_goal_that_was_cancelled_or_is_over_is_told_to_cancel_it():
    for over in (False, True):
        scene = Scene(2)
        scene.accept()
        if over:
            scene.say(0, SUCCEEDED, "result")
            scene.tick()
        else:
            scene.ask("cancel", cancel_request(ID))
            scene.say(0, cancelling(ID), "cancel")
        before = len(scene.given(scene.links[1], "cancel"))
        scene.say(1, ACCEPTED, "goal")
        scene.tick()
        assert scene.given(scene.links[1], "cancel")[before:] == [cancel_request(ID)]


def test_goals_of_an_action_that_is_another_one_now_are_given_to_nobody():
    scene = Scene(1)
    scene.accept()
    for part in scene.parts.values():
        part.close()
    late = FakeLink(7)
    scene.route(late)
    scene.tick(10.0)
    assert scene.given(late, "goal") == []


def test_a_goal_that_a_replica_cannot_read_is_not_given_to_it_again():
    scene = Scene(2)
    scene.accept()
    link = scene.links[1]
    scene.parts["goal"].answered(link, link.refusal("malformed", latest(link, GOAL.name)))
    scene.tick(60.0)
    assert len(scene.given(link, "goal")) == 1


def test_a_result_that_is_turned_away_is_awaited_by_nobody():
    scene = Scene(1)
    scene.ask("goal", HEADER + ID)
    scene.say(0, ACCEPTED, "goal")
    scene.parts["result"].max_pending = 0
    scene.ask("result", HEADER + ID)
    late = FakeLink(7)
    scene.route(late)
    assert scene.given(late, "goal") == []


def test_who_does_not_look_at_a_goal_is_left_alone_for_longer_each_time():
    scene = Scene(2)
    scene.accept()
    link = scene.links[1]
    refused = 0
    for _ in range(200):  # in 20 s
        if len(scene.given(link, "goal")) > refused:
            refused += 1
            scene.parts["goal"].answered(link, link.refusal("overloaded", latest(link, GOAL.name)))
        scene.tick(0.1)
    assert 4 <= len(scene.given(link, "goal")) <= 8


def test_a_goal_that_is_made_while_nobody_is_there_outlives_who_takes_it_first():
    scene = Scene(1)
    (link,) = scene.links
    scene.route()
    scene.ask("goal", HEADER + ID + b"5")
    scene.route(link)
    scene.say(0, ACCEPTED, "goal")
    scene.ask("result", HEADER + ID)
    scene.links = [FakeLink(7)]
    scene.route(*scene.links)
    scene.say(0, ACCEPTED, "goal")
    scene.say(0, SUCCEEDED, "result")
    assert scene.answers[-1] == ("result", SUCCEEDED)


def cancel_accepted(scene: Scene) -> None:
    """The first replica cancels the goal."""
    scene.ask("cancel", cancel_request(ID))
    scene.say(0, cancelling(ID), "cancel")


@pytest.mark.parametrize("away", ["link", "room", "refuses"])
def test_a_cancellation_reaches_who_was_away_for_a_moment(away):
    scene = Scene(2)
    scene.accept()
    first, second = scene.links
    scene.say(1, ACCEPTED, "goal")
    if away == "link":
        scene.route(first)
    second.room = 0 if away == "room" else 1000
    cancel_accepted(scene)
    if away == "refuses":
        refusal = second.refusal("overloaded", latest(second, CANCEL.name))
        scene.parts["cancel"].answered(second, refusal)
    before = len(scene.given(second, "cancel"))
    second.room = 1000
    scene.route(first, second)
    for _ in range(10):
        scene.tick(0.1)
    assert scene.given(second, "cancel")[before:] == [cancel_request(ID)]
    assert len(scene.given(first, "cancel")) == 1


@pytest.mark.parametrize("away", ["link", "room"])
def test_a_loser_is_told_once_it_is_there(away):
    scene = Scene(2)
    scene.accept()
    first, second = scene.links
    scene.say(1, ACCEPTED, "goal")
    if away == "link":
        scene.route(first)
    second.room = 0 if away == "room" else 1000
    scene.say(0, SUCCEEDED, "result")
    scene.tick(1.0)
    assert scene.given(second, "cancel") == []
    second.room = 1000
    scene.route(first, second)
    scene.tick(1.0)
    assert scene.given(second, "cancel") == [cancel_request(ID)]
    scene.tick(1.0)
    assert len(scene.given(second, "cancel")) == 1


def test_who_never_comes_back_is_not_told_for_ever():
    scene = Scene(2)
    scene.accept()
    first, second = scene.links
    scene.say(1, ACCEPTED, "goal")
    scene.route(first)
    scene.say(0, SUCCEEDED, "result")
    for _ in range(70):
        scene.tick(1.0)
    assert scene.parts["cancel"].report()["to_cancel"] == 0
    scene.route(first, second)
    scene.tick(1.0)
    assert scene.given(second, "cancel") == []
