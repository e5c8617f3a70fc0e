"""An action server gets each goal once, however often robots send it."""

from __future__ import annotations

from threading import Thread

import pytest

from fogft.byte_limit import SMALL_BYTES
from fogft.errors import RosError, Unreadable
from fogft.proxy.replica.goals_once import GoalsOnce
from tests.fakes.proxy import Clock, FakeClient, FakeIncoming

SERVICE = "/count/_action/send_goal"
OTHER = "/other/_action/send_goal"
HEADER = b"\0\1\0\0"
ACCEPTED, REFUSED = HEADER + b"\1", HEADER + b"\0"


class Scene:
    def __init__(self, **options) -> None:
        self.clock = Clock()
        self.ready = True
        self.clients = {SERVICE: FakeClient(), OTHER: FakeClient()}
        bounded = type("Bounded", (GoalsOnce,), options)
        self.goals = bounded(self.clients, lambda name: self.ready, clock=self.clock)
        self.goals.use(self.clients)
        self.asked = 0

    @property
    def calls(self):
        return self.clients[SERVICE].calls

    def give(
        self,
        goal: bytes,
        service: str = SERVICE,
        remaining_s: float = 5.0,
        more: bytes = b"",
        robot: str = "robot",
    ) -> FakeIncoming:
        """Every copy of a goal has another request id."""
        self.asked += 1
        id, payload = self.asked.to_bytes(16, "big"), HEADER + goal * 16 + b"5" + more
        incoming = FakeIncoming(id, payload, service=service, remaining_s=remaining_s)
        incoming.robot = robot
        self.goals.request(incoming)
        return incoming

    def say(self, payload: bytes, n: int = -1) -> None:
        self.calls[n][1](payload)

    def wait(self, seconds: float) -> None:
        self.clock.now += seconds
        self.goals.tick()


def test_copies_of_a_goal_join_and_later_ones_get_the_same_answer():
    scene = Scene()
    first, copy = scene.give(b"a"), scene.give(b"a")
    scene.say(ACCEPTED)
    scene.wait(3600.0)
    late = scene.give(b"a")
    assert first.outcome == copy.outcome == late.outcome == [ACCEPTED]
    assert [payload for payload, _ in scene.calls] == [HEADER + b"a" * 16 + b"5"]
    assert scene.goals.in_flight == 0


def test_an_action_server_that_takes_its_time_is_given_a_goal_once():
    """Each copy waits for as long as it may; the last one is there when the answer comes."""
    scene = Scene()
    impatient = [scene.give(b"a")]
    for _ in range(2):
        scene.wait(5.0)
        impatient.append(scene.give(b"a"))
    assert [copy.outcome for copy in impatient] == [["refused expired"], ["refused expired"], []]
    scene.say(ACCEPTED)
    assert impatient[-1].outcome == [ACCEPTED]
    assert len(scene.calls) == 1


def test_a_goal_that_is_begun_as_its_action_server_dies_is_not_given_to_the_next():
    """Its robot is told, and gives it to the next itself."""
    scene, after = Scene(), FakeClient()

    def die() -> None:
        scene.goals.crashed()
        scene.goals.use({SERVICE: after})

    class Dying(dict):
        def get(self, service: str) -> FakeClient:
            if death.ident is None:
                death.start()
                death.join(0.2)  # or until then, where it has to wait for us
            return self[service] if death.is_alive() else after

    death = Thread(target=die)
    scene.goals.use(Dying(scene.clients))
    given = scene.give(b"a")
    death.join()
    assert given.outcome == ["refused crashed"]
    assert after.calls == []


def test_an_acceptance_that_nobody_waits_for_is_remembered():
    scene = Scene()
    scene.give(b"a")
    scene.wait(3600.0)
    scene.say(ACCEPTED)
    assert scene.give(b"a").outcome == [ACCEPTED]
    assert len(scene.calls) == 1


def test_other_goals_and_other_actions_are_others():
    scene = Scene()
    for goal, service in ((b"a", SERVICE), (b"b", SERVICE), (b"a", OTHER)):
        scene.give(goal, service)
    assert [len(client.calls) for client in scene.clients.values()] == [2, 1]


def test_a_goal_that_was_refused_may_be_sent_again():
    scene = Scene()
    first = scene.give(b"a")
    scene.say(REFUSED)
    again = scene.give(b"a")
    scene.say(ACCEPTED)
    assert (first.outcome, again.outcome) == ([REFUSED], [ACCEPTED])


def test_no_more_are_given_at_once_than_its_queue_holds():
    scene = Scene(outstanding=2)
    asked = [scene.give(bytes([n])) for n in range(4)]
    assert len(scene.calls) == 2
    scene.say(ACCEPTED, 0)
    assert len(scene.calls) == 3
    scene.wait(6.0)  # the fourth was never begun, and nobody wants it now
    assert [one.outcome[0] for one in asked] == [ACCEPTED, *["refused expired"] * 3]
    for n in (1, 2):
        scene.say(ACCEPTED, n)
    assert len(scene.calls) == 3
    assert scene.goals.in_flight == 0


def test_one_robot_that_has_many_goals_keeps_no_other_out():
    scene = Scene(outstanding=1)
    for n in range(200):
        scene.give(bytes([n]), more=b"%03d" % n, robot="eve", remaining_s=3600.0)
    ours = scene.give(b"\xff", robot="ann")
    scene.say(ACCEPTED)
    assert scene.calls[-1][0].startswith(HEADER + b"\xff"), "robots take turns"
    scene.say(ACCEPTED)
    assert ours.outcome == [ACCEPTED]
    large = Scene()
    large.give(b"a", more=bytes(60 << 20), robot="eve")
    assert large.give(b"b", more=bytes(5 << 20), robot="eve").outcome == ["refused overloaded"]
    assert large.give(b"c", more=bytes(5 << 20), robot="ann").outcome == []


def test_who_does_not_answer_for_long_is_given_others_and_may_answer_yet():
    scene = Scene(outstanding=1)
    scene.give(b"a")
    other = scene.give(b"b", remaining_s=3600.0)
    scene.wait(61.0)
    assert len(scene.calls) == 2
    scene.say(ACCEPTED, 0)
    assert scene.give(b"a").outcome == [ACCEPTED]
    scene.say(ACCEPTED, 1)
    assert other.outcome == [ACCEPTED]


@pytest.mark.parametrize("service", ["", SERVICE, "/count/_action/get_result"])
def test_who_comes_after_a_crash_knows_no_goals(service):
    """Whichever part of the action was seen to be gone first."""
    scene = Scene()
    scene.give(b"a")
    scene.say(ACCEPTED)
    under_way = scene.give(b"b")
    scene.goals.crashed(service)
    assert under_way.outcome == ["refused crashed"]
    for goal in (b"a", b"b"):
        again = scene.give(goal)
        assert again.outcome == []
        scene.say(ACCEPTED)
        assert again.outcome == [ACCEPTED]
    assert len(scene.calls) == 4


def test_an_answer_of_the_dead_says_nothing_of_the_living():
    scene = Scene()
    scene.give(b"a")
    scene.goals.crashed()
    scene.give(b"a")
    scene.say(ACCEPTED, 0)
    assert scene.give(b"a").outcome == []


def test_the_crash_of_another_service_changes_nothing():
    scene = Scene()
    first = scene.give(b"a")
    for service in (OTHER, "/map"):
        scene.goals.crashed(service)
    copy = scene.give(b"a")
    scene.say(ACCEPTED)
    scene.goals.crashed(OTHER)
    assert first.outcome == copy.outcome == scene.give(b"a").outcome == [ACCEPTED]
    assert len(scene.calls) == 1


def test_the_end_of_our_own_node_gives_no_goal_again():
    """The action server lives on, with what it was given; what it was not given it may be."""
    scene = Scene(outstanding=2)
    scene.give(b"a")
    scene.say(ACCEPTED)
    given, waits = scene.give(b"b"), [scene.give(b"c"), scene.give(b"d")][1]
    scene.goals.left_ros()
    assert waits.outcome == ["refused not-ready"]
    assert scene.give(b"a").outcome == [ACCEPTED]
    scene.give(b"b")
    assert given.outcome == []
    assert len(scene.calls) == 3
    assert scene.give(b"d").outcome == []
    assert len(scene.calls) == 4


def test_what_cannot_be_passed_on_is_refused_and_may_be_sent_again():
    scene = Scene()
    for broken, reason in (
        (RosError("its queue is full"), "overloaded"),
        (Unreadable("too short"), "malformed"),
    ):
        scene.clients[SERVICE].broken = broken
        assert scene.give(b"a").outcome == [f"refused {reason}"]
    scene.clients[SERVICE].broken = None
    scene.ready = False
    assert scene.give(b"a").outcome == ["refused not-ready"]
    scene.ready = True
    assert scene.give(b"a", remaining_s=0.0).outcome == ["refused expired"]
    again = scene.give(b"a")
    scene.say(ACCEPTED)
    assert again.outcome == [ACCEPTED]


def test_what_waits_and_what_is_remembered_is_bounded():
    scene = Scene(accepted_kept=1, outstanding=1)
    for goal in (b"a", b"b"):
        scene.give(goal)
        scene.say(ACCEPTED)
    assert scene.give(b"b").outcome == [ACCEPTED]
    assert scene.give(b"a").outcome == []
    outcomes = [scene.give(n.to_bytes(2, "big")) for n in range(600)]
    assert sum(one.outcome == ["refused overloaded"] for one in outcomes) == 600 - 512
    copies = [scene.give(b"a") for _ in range(100)]
    assert sum(one.outcome == ["refused overloaded"] for one in copies) == 100 - 63


def test_an_error_in_a_reply_does_not_hold_up_the_next_goal():
    scene = Scene(outstanding=1)
    first, second = scene.give(b"a"), scene.give(b"b")

    def fail(payload: bytes, *, more: bool = False) -> None:
        raise OSError("can't start new thread")

    first.reply = fail
    with pytest.raises(OSError, match="thread"):
        scene.say(ACCEPTED)
    scene.say(ACCEPTED)
    assert second.outcome == [ACCEPTED]


def test_what_an_action_server_was_given_too_much_of_begins_anew():
    """It was silent for long, so it was given more than its queue holds, which lost the oldest."""
    scene = Scene(outstanding=1)
    lost = scene.give(b"a", remaining_s=3600.0)
    scene.give(b"b", remaining_s=3600.0)
    scene.wait(61.0)
    scene.say(ACCEPTED, 1)
    assert lost.outcome == ["refused lost"]
    again = scene.give(b"a")
    scene.say(ACCEPTED, 2)
    assert again.outcome == [ACCEPTED]


def test_what_is_held_is_bounded_by_bytes_and_a_large_one_alone_passes(monkeypatch):
    monkeypatch.setattr("fogft.proxy.replica.goals_once._BYTES_LIMIT", 3 * SMALL_BYTES)
    scene, large = Scene(outstanding=0), bytes(SMALL_BYTES)  # none is passed on
    assert [scene.give(goal, more=large).outcome for goal in (b"a", b"b", b"c")] == [
        [], [], ["refused overloaded"],
    ]  # fmt: skip
    assert scene.give(b"a", more=large).outcome == ["refused overloaded"]
    assert scene.give(b"d").outcome == []
    scene.wait(6.0)
    monkeypatch.setattr("fogft.proxy.replica.goals_once._BYTES_LIMIT", 1)
    assert scene.give(b"d").outcome == []
    assert scene.give(b"a", more=large).outcome == []


def test_the_parts_of_one_action_server_die_once():
    """Its successor may have taken a goal between two looks; a later death is another one."""
    scene = Scene()
    scene.goals.crashed(SERVICE)
    scene.give(b"a")
    scene.say(ACCEPTED)
    scene.clock.now += 0.1
    scene.goals.crashed("/count/_action/get_result")
    assert scene.give(b"a").outcome == [ACCEPTED]
    scene.clock.now += 2.0
    scene.goals.crashed("/count/_action/get_result")
    assert scene.give(b"a").outcome == []
    scene.goals.crashed("/count/_action/get_result")
    scene.give(b"a")
    assert len(scene.calls) == 3
