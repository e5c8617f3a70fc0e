"""The replica runs a request id once and answers every copy of it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.byte_limit import SMALL_BYTES
from fogft.errors import RosError, Unreadable
from fogft.proxy.replica.responder import EMPTY_REQUEST, Responder
from fogft.requests.load import Handling, Load
from fogft.topics import goals
from tests.fakes.proxy import Clock, FakeClient, FakeIncoming
from tests.fakes.threads import meanwhile

A = b"a" * 16
B, C, D = b"b" * 16, b"c" * 16, b"d" * 16


UNKNOWN = bytes((0, 1, 0, 0, 0))  # a result: the goal is not known
BOUNDS = {"held_limit", "held_bytes", "outstanding", "kept_bytes", "kept_ids"}


class Scene:
    def __init__(self, **options) -> None:
        self.clock = Clock()
        self.ready = True
        self.client = FakeClient()
        bounds = {name: options.pop(name) for name in BOUNDS & options.keys()}
        bounded = type("Bounded", (Responder,), bounds)
        self.responder = bounded(lambda name: self.ready, clock=self.clock, **options)
        self.responder.use({"/s": self.client})

    def ask(self, id: bytes, **options) -> FakeIncoming:
        incoming = FakeIncoming(id, **options)
        self.responder.request(incoming)
        return incoming

    def answer(self, n: int, payload: bytes = b"r") -> None:
        self.client.calls[n][1](payload)


def test_a_copy_that_comes_after_the_deadline_of_the_first_is_not_run_beside_it():
    """Of two uplinks the far one leaves a replica less time than the near one."""
    scene = Scene()
    first = scene.ask(A, remaining_s=0.7)
    scene.clock.now += 0.75
    scene.responder.tick()
    assert first.outcome == ["refused expired"]
    scene.ask(A, remaining_s=0.2)
    assert len(scene.client.calls) == 1


def test_a_request_is_run_and_answered():
    scene = Scene()
    incoming = scene.ask(A, payload=b"q")
    assert scene.client.calls[0][0] == b"q"
    scene.answer(0, b"r")
    assert incoming.outcome == [b"r"]
    assert scene.responder.in_flight == 0


def test_only_an_answer_beside_which_nothing_is_at_work_leaves_alone():
    scene = Scene()
    first, second = scene.ask(A), scene.ask(B)
    scene.answer(0)
    scene.answer(1)
    assert (first.more, second.more) == (True, False)


def test_an_answer_leaves_before_it_is_counted_and_makes_room_after():
    """The robot does not wait for our numbers; what it sends next is passed on all the same."""
    scene = Scene(limits={"/s": 1})
    first, second = scene.ask(A), scene.ask(B)
    ran_s: list[float] = []
    first.reply = lambda payload, **_: ran_s.append(scene.responder.work["ran_s"])
    scene.clock.now += 1.0
    scene.answer(0)
    assert (ran_s, scene.responder.work["ran_s"]) == ([0.0], 1.0)
    scene.answer(1)
    assert second.outcome == [b"r"]
    assert scene.responder.in_flight == 0


def test_a_spare_copy_is_dropped_where_it_would_have_to_wait_and_that_is_told():
    """A service of which nothing is known is taken to do one thing at a time."""
    scene = Scene()
    scene.ask(A)
    spare = FakeIncoming(B, handling=Handling.DROP_IF_BUSY)
    scene.responder.request(spare)
    assert spare.outcome == ["refused busy"]
    scene.clock.now += 0.5
    scene.answer(0)
    spare = FakeIncoming(B, handling=Handling.DROP_IF_BUSY)
    scene.responder.request(spare)
    dropped = scene.ask(C, handling=Handling.DROP_IF_BUSY)
    assert (dropped.outcome, dropped.load) == (["refused busy"], Load(0, 1, 0, 0.5, 0.0))
    scene.answer(1)
    assert spare.outcome == [b"r"]


def test_a_spare_copy_waits_for_what_is_nearly_over_and_never_before_what_is_none():
    """A caller asks again as soon as the first has answered: the others are about to."""
    scene = Scene(limits={"/s": 1})
    scene.ask(A)
    scene.clock.now += 1.0
    scene.answer(0)  # it takes a second
    scene.ask(B)
    scene.clock.now += 0.9
    spare = scene.ask(C, handling=Handling.DROP_IF_BUSY)
    first = scene.ask(D)
    scene.answer(1)
    scene.answer(2)
    assert (first.outcome, spare.outcome) == ([b"r"], [])
    scene.answer(3)
    assert spare.outcome == [b"r"]


def test_a_spare_copy_of_what_is_at_work_joins_it():
    scene = Scene()
    first = scene.ask(A)
    copy = FakeIncoming(A, handling=Handling.DROP_IF_BUSY)
    scene.responder.request(copy)
    scene.answer(0)
    assert (first.outcome, copy.outcome) == ([b"r"], [b"r"])


def test_what_a_service_died_over_runs_alone():
    """So that, if it dies again, nothing innocent is blamed with it."""
    scene = Scene(limits={"/s": 4})
    scene.ask(A)
    scene.ask(B, handling=Handling.ALONE)
    scene.ask(C)
    assert len(scene.client.calls) == 1
    scene.answer(0)
    assert len(scene.client.calls) == 2
    scene.responder.tick()
    assert len(scene.client.calls) == 2  # C waits for it
    assert scene.responder.at_work == 1
    scene.answer(1)
    assert len(scene.client.calls) == 3


def test_each_end_tells_the_load_without_what_has_just_ended():
    """What waits and runs, the limit where it is known, the time that one takes and took."""
    scene = Scene(limits={"/s": 2})
    alone = scene.ask(D)
    scene.clock.now += 0.5
    scene.answer(0)
    assert alone.load is None  # nothing was known when it left
    first, second, third = scene.ask(A), scene.ask(B), scene.ask(C)
    scene.clock.now += 0.5
    scene.answer(1)
    assert first.load == Load(waiting=1, running=1, slots=2, service_s=0.5, spent_s=0.5)
    scene.responder.cancel([C])  # it has begun, so it goes on
    scene.clock.now += 0.5
    scene.answer(2)
    assert second.load == Load(0, 1, 2, pytest.approx(0.5), 1.0)
    scene.answer(3)
    assert third.outcome == ["refused late"]
    assert third.load == Load(0, 0, 2, pytest.approx(0.5, abs=0.05), 1.0)


def test_what_would_miss_its_deadline_is_not_begun_while_others_would_not():
    """Over capacity, work for those that come too late would cost the answers of the others."""
    scene = Scene(limits={"/s": 1})
    scene.ask(A)
    scene.clock.now += 1.0
    scene.answer(0)  # it takes a second
    scene.ask(B)
    hurried = FakeIncoming(C, remaining_s=1.5)
    scene.responder.request(hurried)
    patient = scene.ask(D)
    scene.clock.now += 1.0
    scene.answer(1)
    assert hurried.outcome == ["refused expired"]
    scene.answer(2)
    assert patient.outcome == [b"r"]


def test_a_copy_joins_the_work_in_progress():
    scene = Scene()
    first, copy = scene.ask(A), scene.ask(A)
    scene.answer(0, b"r")
    assert (first.outcome, copy.outcome) == ([b"r"], [b"r"])
    assert scene.responder.work["ran"] == 1


def test_few_copies_of_one_request_are_held():
    """Each is of a connection: of one that asks again and again the oldest are long gone."""
    scene = Scene()
    copies = [scene.ask(A) for _ in range(100)]
    (job,) = scene.responder.known.unanswered(None)
    assert len(job.waiting) < 10
    scene.answer(0)
    assert copies[-1].outcome == [b"r"]


def test_a_reply_that_cannot_be_sent_keeps_no_room():
    """What waits for it goes on, and the next requests too."""
    scene = Scene(limits={"/s": 1})
    first, second = scene.ask(A), scene.ask(B)

    def fail(payload: bytes, **_: object) -> None:
        raise OSError("can't start new thread")

    first.reply = fail
    with pytest.raises(OSError, match="thread"):
        scene.answer(0)
    scene.answer(1)
    assert second.outcome == [b"r"]
    assert scene.responder.in_flight == 0


def test_whoever_waits_behind_a_request_that_ros_refuses_does_not_wait_longer():
    """It came while that was being passed on."""
    scene = Scene(limits={"/s": 1})
    call, waiting = scene.client.call, []

    def refuse(payload: bytes, on_response) -> int:
        scene.client.call = call
        waiting.append(scene.ask(B))
        raise RosError("its queue is full")

    scene.client.call = refuse
    assert scene.ask(A).outcome == ["refused overloaded"]
    scene.answer(0)
    assert waiting[0].outcome == [b"r"]


def test_deadlines_of_what_was_forgotten_do_not_pile_up():
    """An id that is run anew, again and again, and more ids than are kept."""
    scene = Scene(results=["/s"], kept_ids=10)
    for n in range(2000):
        scene.ask(A, remaining_s=3600.0)
        scene.answer(n, UNKNOWN)
    for n in range(2000):
        scene.ask(n.to_bytes(16, "big"), remaining_s=3600.0)
        scene.answer(2000 + n)
    assert len(scene.responder.known) < 1200
    for seconds in (3601.0, 121.0):
        scene.clock.now += seconds
        scene.responder.tick()
    assert len(scene.responder.known) == 0


def test_a_copy_of_finished_work_gets_the_kept_answer():
    scene = Scene()
    scene.ask(A)
    scene.answer(0, b"r")
    assert scene.ask(A).outcome == [b"r"]
    assert len(scene.client.calls) == 1


def test_an_answer_for_the_moment_is_not_kept_and_a_copy_is_run_anew():
    scene = Scene(results=["/s"])
    first = scene.ask(A)
    scene.answer(0, UNKNOWN)
    copy = scene.ask(A)
    assert (first.outcome, copy.outcome) == ([UNKNOWN], [])
    scene.answer(1, b"r")
    assert (copy.outcome, scene.ask(A).outcome) == ([b"r"], [b"r"])
    assert (scene.responder.in_flight, len(scene.client.calls)) == (0, 2)


def test_results_are_asked_for_no_faster_than_an_action_server_takes_the_requests():
    """They are answered when goals end; of what it has not taken, its queue keeps the last ten."""
    scene = Scene(results=["/s"], limits={"/s": 512})
    asked = [
        scene.ask(bytes([n]) * 16, payload=b"result", remaining_s=3600.0) for n in range(1, 41)
    ]
    calls, seen = scene.client.calls, 0
    for _ in range(5):
        payloads = [payload for payload, _ in calls[seen:]]
        assert payloads == [b"result"] * 8 + [goals.RESULT_OF_NONE]
        seen = len(calls)
        calls[-1][1](UNKNOWN)  # it has taken all before
    assert scene.responder.at_work == 40
    for payload, answer in list(calls):
        if payload == b"result":
            answer(b"r")
    assert [one.outcome for one in asked] == [[b"r"]] * 40


def test_an_action_server_that_takes_nothing_for_a_minute_or_is_new_is_asked_again():
    scene = Scene(results=["/s"], limits={"/s": 512})
    for n in range(1, 25):
        scene.ask(bytes([n]) * 16, payload=b"result", remaining_s=3600.0)
    assert len(scene.client.calls) == 9
    scene.clock.now += 61.0
    scene.responder.tick()
    assert len(scene.client.calls) == 18
    scene.responder.crashed()
    scene.ask(B, payload=b"result", remaining_s=3600.0)
    assert len(scene.client.calls) == 19


def test_result_requests_that_cannot_be_sent_are_none_of_a_batch():
    """Else those of one robot would keep the results of all until a goal ends."""
    scene = Scene(results=["/s"], limits={"/s": 512})
    scene.ask(A, remaining_s=3600.0)
    call = scene.client.call
    for n in range(1, 12):
        scene.client.call = refuse_to_read
        assert scene.ask(bytes([n]) * 16).outcome == ["refused malformed"]
    scene.client.call = call
    for n in range(20, 27):
        scene.ask(bytes([n]) * 16, payload=b"result", remaining_s=3600.0)
    assert [payload for payload, _ in scene.client.calls[1:]] == [b"result"] * 7 + [
        goals.RESULT_OF_NONE
    ]


def refuse_to_read(payload: bytes, _: object) -> int:
    raise Unreadable(f"{payload!r} is no request")


def test_an_interrupted_service_that_has_nothing_left_does_not_hang():
    """Its last request ends before its cancel service has answered."""
    scene = Scene(limits={"/s": 1})
    cancel = FakeClient()
    scene.responder.use({"/s": scene.client}, {"/s": cancel})
    scene.ask(A)
    scene.clock.now += 0.5
    scene.answer(0)
    scene.ask(B)
    scene.responder.cancel([B])
    scene.answer(1)
    cancel.calls[0][1](b"ok")
    scene.clock.now += 70.0
    assert scene.responder.hanging() == {}


def test_what_waits_at_one_service_keeps_nothing_from_another():
    """An action's results may wait for hours."""
    scene = Scene(held_limit=4, limits={"/s": 512})
    scene.responder.use({"/s": scene.client, "/other": (other := FakeClient())})
    for n in range(1, 9):
        scene.ask(bytes([n]) * 16, remaining_s=3600.0)
    scene.ask(B, service="/other")
    assert (len(scene.client.calls), len(other.calls)) == (4, 1)


def test_one_robot_s_large_requests_keep_no_other_s_out():
    scene = Scene(held_bytes=200_000, limits={"/s": 1})
    for n in range(1, 9):
        scene.ask(bytes([n]) * 16, payload=bytes(60_000), robot="eve", remaining_s=1e7)
    first, second = (scene.ask(id, payload=bytes(60_000), robot="ada") for id in (A, B))
    assert (first.outcome, second.outcome) == ([], ["refused overloaded"])


def test_a_copy_whose_answer_is_no_longer_kept_is_refused_not_run_again():
    scene = Scene(kept_bytes=3)
    scene.ask(A)
    scene.answer(0, b"long answer")
    assert scene.ask(A).outcome == ["refused forgotten"]
    assert len(scene.client.calls) == 1


def test_a_service_that_is_not_there_refuses_at_once():
    scene = Scene()
    scene.ready = False
    assert scene.ask(A).outcome == ["refused not-ready"]


def test_an_unknown_service_is_refused():
    assert Scene().ask(A, service="/other").outcome == ["refused not-ready"]


def test_more_than_the_window_is_refused():
    scene = Scene(held_limit=1)
    scene.ask(A)
    assert scene.ask(B).outcome == ["refused overloaded"]
    scene.answer(0)
    assert scene.ask(b"c" * 16).outcome == []


def test_no_more_is_passed_on_than_an_ordinary_service_keeps():
    """A ROS service with the default queue silently loses what exceeds ten."""
    scene = Scene()
    asked = [scene.ask(bytes([n]) * 16) for n in range(25)]
    assert len(scene.client.calls) == 10
    for n in range(25):
        scene.answer(n)
        assert len(scene.client.calls) == min(25, 11 + n)
    assert all(incoming.outcome == [b"r"] for incoming in asked)


def test_what_waits_past_its_deadline_is_never_begun():
    scene = Scene(outstanding=1)
    scene.ask(A, remaining_s=9.0)
    waiting = scene.ask(B, remaining_s=1.0)
    scene.clock.now += 2.0
    scene.answer(0)
    assert waiting.outcome == ["refused expired"]
    assert len(scene.client.calls) == 1


def test_a_copy_joins_what_waits():
    scene = Scene(outstanding=1)
    scene.ask(A)
    first, copy = scene.ask(B), scene.ask(B)
    scene.answer(0)
    scene.answer(1, b"b")
    assert (first.outcome, copy.outcome) == ([b"b"], [b"b"])


def test_expired_work_keeps_its_room_until_the_service_is_done_with_it():
    """The service still has it in its queue: passing on more would overflow that queue."""
    scene = Scene(outstanding=1)
    scene.ask(A, remaining_s=1.0)
    waiting = scene.ask(B, remaining_s=9.0)
    scene.clock.now += 1.0
    scene.responder.tick()
    assert len(scene.client.calls) == 1
    scene.answer(0, b"too late")
    scene.answer(1, b"b")
    assert waiting.outcome == [b"b"]


def test_a_response_that_never_comes_frees_its_room_in_the_end():
    scene = Scene(outstanding=1)
    scene.ask(A, remaining_s=1.0)
    for _ in range(2):
        scene.clock.now += 61.0
        scene.responder.tick()
    scene.ask(B)
    assert len(scene.client.calls) == 2
    assert scene.client.forgotten == [1]


def test_a_crash_ends_what_waits_too_and_does_not_blame_it():
    """A robot bars a replica that crashed on a request three times; this one was not begun."""
    scene = Scene(outstanding=1)
    asked = [scene.ask(A), scene.ask(B)]
    scene.responder.crashed()
    assert [incoming.outcome for incoming in asked] == [["refused crashed"], ["refused not-ready"]]
    scene.ask(b"c" * 16)
    assert scene.responder.in_flight == 1


def test_a_request_past_its_deadline_is_never_begun():
    scene = Scene()
    assert scene.ask(A, remaining_s=0.0).outcome == ["refused expired"]
    assert scene.client.calls == []


def test_a_request_the_service_cannot_read_is_refused_and_can_be_sent_again():
    scene = Scene()
    scene.client.broken = Unreadable("too short")
    assert scene.ask(A).outcome == ["refused malformed"]
    assert scene.responder.in_flight == 0


def test_a_request_that_ros_has_no_room_for_may_be_sent_again():
    """Malformed would keep the robot from ever asking this replica again."""
    scene = Scene()
    scene.client.broken = RosError("its queue is full")
    assert scene.ask(A).outcome == ["refused overloaded"]
    scene.client.broken = None
    again = scene.ask(A)
    scene.answer(0, b"r")
    assert again.outcome == [b"r"]


def test_held_bytes_are_bounded():
    """A robot whose requests others answer first goes on sending: its window is free again.

    One that is larger than the limit passes beside small ones, and they pass beside it.
    """
    scene = Scene(held_bytes=10)
    small, large = b"q", bytes(SMALL_BYTES + 1)
    assert scene.ask(A, payload=small).outcome == []
    big = scene.ask(B, payload=large)
    assert scene.ask(b"c" * 16, payload=large).outcome == ["refused overloaded"]
    assert scene.ask(b"d" * 16, payload=small).outcome == []
    scene.answer(1, b"r")
    assert big.outcome == [b"r"]
    assert scene.ask(b"c" * 16, payload=large).outcome == []


def test_a_service_that_was_lost_frees_its_room_and_no_other():
    """A frozen or restarted service does not answer what it was given: others shall not wait."""
    scene = Scene(outstanding=1)
    other = FakeClient()
    scene.responder.use({"/s": scene.client, "/other": other})
    lost, spared = scene.ask(A), scene.ask(B, service="/other")
    late = scene.ask(b"c" * 16, remaining_s=1.0)
    scene.responder.crashed("/s")
    assert (lost.outcome, spared.outcome) == (["refused crashed"], [])
    assert late.outcome == ["refused not-ready"]
    scene.ask(b"d" * 16)
    assert len(scene.client.calls) == 2


def test_a_lost_service_frees_the_room_of_expired_work_too():
    scene = Scene(outstanding=1)
    scene.ask(A, remaining_s=1.0)
    scene.clock.now += 1.0
    scene.responder.tick()
    scene.responder.crashed("/s")
    scene.ask(B)
    assert len(scene.client.calls) == 2


def test_a_crash_refuses_what_was_in_work_and_a_copy_is_run_anew():
    scene = Scene()
    incoming = scene.ask(A)
    scene.responder.crashed()
    assert incoming.outcome == ["refused crashed"]
    assert scene.client.forgotten == [1]
    again = scene.ask(A)
    scene.answer(1, b"r")
    assert again.outcome == [b"r"]


def test_an_answer_after_the_crash_reaches_nobody():
    scene = Scene()
    incoming = scene.ask(A)
    scene.responder.crashed()
    scene.answer(0, b"ghost")
    assert incoming.outcome == ["refused crashed"]


def test_work_past_its_deadline_is_dropped():
    scene = Scene()
    incoming = scene.ask(A, remaining_s=2.0)
    scene.clock.now += 2.0
    scene.responder.tick()
    assert incoming.outcome == ["refused expired"]
    assert scene.responder.in_flight == 0


def test_ids_past_their_deadline_are_the_first_to_make_room():
    scene = Scene(kept_ids=3)
    scene.ask(A, remaining_s=300.0)
    scene.answer(0, b"r")
    for n in range(5):
        scene.ask(n.to_bytes(16, "big"), remaining_s=1.0)
        scene.answer(n + 1)
        scene.clock.now += 1.0
        scene.responder.tick()
    assert scene.ask(A, remaining_s=200.0).outcome == [b"r"]


def test_finished_ids_are_forgotten_when_no_copy_can_come_any_more():
    """Memory stays flat. A copy that a slow uplink brings after the deadline is not run."""
    scene = Scene()
    for n in range(1000):
        scene.ask(n.to_bytes(16, "big"), remaining_s=1.0)
        scene.answer(n)
    scene.clock.now += 1.0
    scene.responder.tick()
    assert scene.ask(bytes(16), remaining_s=1.0).outcome == ["refused forgotten"]
    assert len(scene.client.calls) == 1000
    scene.clock.now += 120.0
    scene.responder.tick()
    assert len(scene.responder.known) == 0


@pytest.mark.parametrize("wanted", [True, False])
def test_the_number_of_ids_is_bounded(wanted):
    """Also of requests that other replicas answered, whose end comes here."""
    scene = Scene(kept_ids=10)
    for n in range(100):
        scene.ask(n.to_bytes(16, "big"))
        if not wanted:
            scene.responder.cancel([n.to_bytes(16, "big")])
        scene.answer(n)
    assert len(scene.responder.known) <= 10 + 100


def test_what_waits_and_is_no_longer_wanted_is_dropped_and_counted():
    scene = Scene(outstanding=1)
    scene.ask(A)
    unwanted = scene.ask(B)
    scene.responder.cancel([B, b"unknown id 12345"])
    assert unwanted.outcome == ["refused cancelled"]
    scene.answer(0)
    assert len(scene.client.calls) == 1
    assert (scene.responder.work["saved"], scene.responder.in_flight) == (1, 0)


def test_what_is_at_work_and_no_longer_wanted_is_counted_as_wasted_and_its_bytes_stay_here():
    scene = Scene()
    unwanted = scene.ask(A)
    scene.responder.cancel([A])
    scene.clock.now += 2.0
    scene.answer(0, b"a large answer")
    assert unwanted.outcome == ["refused late"]
    assert (scene.responder.work["wasted"], scene.responder.work["wasted_s"]) == (1, 2.0)


def test_an_answer_after_the_deadline_is_counted_as_wasted():
    scene = Scene()
    scene.ask(A, remaining_s=1.0)
    scene.clock.now += 1.5
    scene.responder.tick()
    scene.answer(0)
    assert scene.responder.work["wasted"] == 1


def test_what_is_answered_cannot_be_cancelled():
    scene = Scene()
    scene.ask(A)
    scene.answer(0, b"r")
    scene.responder.cancel([A])
    assert scene.ask(A).outcome == [b"r"]
    assert scene.responder.work["saved"] == 0


def interruptible() -> tuple[Scene, FakeClient]:
    scene = Scene(limits={"/s": 1})
    stop = FakeClient()
    scene.responder.use({"/s": scene.client}, {"/s": stop})
    return scene, stop


def test_a_cancel_service_is_called_for_what_is_at_work():
    scene, stop = interruptible()
    scene.ask(A)
    scene.responder.cancel([A])
    assert [payload for payload, _ in stop.calls] == [EMPTY_REQUEST]
    assert scene.responder.work["interrupted"] == 1


def test_nothing_is_begun_before_the_cancel_service_has_answered():
    """It names no request: what it stopped might be the next one."""
    scene, stop = interruptible()
    scene.ask(A)
    wanted = scene.ask(B)
    scene.responder.cancel([A])
    scene.answer(0, b"stopped")
    assert len(scene.client.calls) == 1
    stop.calls[0][1](b"ok")
    scene.answer(1, b"b")
    assert wanted.outcome == [b"b"]


def test_a_cancel_service_that_is_dead_holds_nothing_up_for_long():
    scene, stop = interruptible()
    scene.ask(A)
    scene.ask(B)
    scene.responder.cancel([A])
    scene.answer(0)
    scene.clock.now += 3.0
    scene.responder.tick()
    assert len(scene.client.calls) == 2
    scene.responder.cancel([B])
    stop.broken = RosError("closed")
    scene.answer(1)
    scene.ask(b"c" * 16)
    scene.clock.now += 3.0
    scene.responder.tick()
    assert len(scene.client.calls) == 3


def test_a_service_without_a_cancel_service_works_on():
    scene = Scene()
    scene.ask(A)
    scene.responder.cancel([A])
    assert scene.responder.work["interrupted"] == 0


def test_the_earliest_deadline_is_begun_first():
    scene = Scene(outstanding=1)
    scene.ask(A)
    scene.ask(B, payload=b"later", remaining_s=9.0)
    scene.ask(b"c" * 16, payload=b"sooner", remaining_s=2.0)
    scene.answer(0)
    assert scene.client.calls[1][0] == b"sooner"


def test_a_chatty_robot_does_not_starve_another():
    scene = Scene(outstanding=1)
    for n in range(50):
        scene.ask(n.to_bytes(16, "big"), payload=b"chatty", robot="chatty")
    scene.ask(A, payload=b"quiet", robot="quiet")
    for n in range(2):
        scene.answer(n)
    assert b"quiet" in [payload for payload, _ in scene.client.calls[:3]]


def test_what_cannot_begin_yet_saves_up_no_turns_for_its_robot():
    """What is to run alone waits, whatever comes meanwhile: then its robot is served in turns."""
    scene = Scene(limits={"/s": 2})
    scene.ask(A)
    scene.ask(B, robot="a", handling=Handling.ALONE)
    for robot in ("b", "a"):
        for n in range(20):
            scene.ask(robot.encode() + bytes([n]) * 15, payload=robot.encode(), robot=robot)
    for n in range(8):
        scene.answer(n)
    served = [payload for payload, _ in scene.client.calls[2:]]
    assert served.count(b"b") >= 3


def test_when_full_the_chatty_robot_gives_way_to_another():
    scene = Scene(held_limit=4, outstanding=1)
    chatty = [scene.ask(bytes([n]) * 16, robot="chatty", remaining_s=5.0 + n) for n in range(4)]
    quiet = scene.ask(A, robot="quiet")
    assert chatty[3].outcome == ["refused overloaded"]
    assert quiet.outcome == []
    assert scene.ask(B, robot="chatty").outcome == ["refused overloaded"]
    assert scene.responder.in_flight == 4


def test_a_request_that_would_wait_past_its_deadline_is_refused_at_once():
    """The robot asks another replica while there is time."""
    scene = Scene(limits={"/s": 1})
    scene.ask(A)
    scene.clock.now += 1.0
    scene.answer(0)  # it takes a second
    for n in range(3):
        scene.ask(bytes([n]) * 16)
    assert scene.ask(b"h" * 16, remaining_s=1.5).outcome == []  # the earliest deadline is next
    late = scene.ask(b"i" * 16, remaining_s=1.6)
    assert (late.outcome, late.load) == (["refused overloaded"], Load(3, 1, 1, 1.0, 0.0))
    assert scene.ask(b"j" * 16, remaining_s=9.0).outcome == []


def test_a_given_limit_is_kept():
    scene = Scene(limits={"/s": 3})
    for n in range(9):
        scene.ask(bytes([n]) * 16)
    assert len(scene.client.calls) == 3


def saturated(takes_s: float, answers: int = 150) -> Scene:
    """Return a replica that has learned that its service does one thing at a time."""
    scene = Scene()
    for n in range(answers + 10):
        scene.ask(n.to_bytes(16, "big"), remaining_s=1000.0)
    for ended in range(answers):
        scene.clock.now += takes_s
        scene.answer(ended)
    assert scene.responder.limits == {"/s": 1}
    return scene


def test_a_short_service_has_its_next_request_in_hand_and_a_long_one_does_not():
    """So it never stands still between two; the next one's time counts from its turn."""
    scene = saturated(0.02)
    assert len(scene.client.calls) == 152
    before = scene.responder.work["ran_s"]
    scene.clock.now += 0.02
    scene.answer(150)
    assert scene.responder.work["ran_s"] - before == pytest.approx(0.02)
    assert len(saturated(0.2).client.calls) == 151


@given(
    st.lists(
        st.tuples(st.sampled_from(["ask", "answer", "crash", "wait", "cancel"]), st.integers(0, 3)),
        max_size=50,
    )
)
def test_every_copy_gets_exactly_one_outcome_and_runs_never_overlap(steps):
    """Each incoming ends at most once; an id is never in two runs at the same time."""
    scene = Scene(kept_bytes=8, outstanding=2)
    asked: list[FakeIncoming] = []
    finished: set[int] = set()
    for step, n in steps:
        if step == "ask":
            asked.append(scene.ask(bytes([n]) * 16, payload=bytes([n]), remaining_s=5.0))
        elif step == "answer" and n < len(scene.client.calls):
            payload, _ = scene.client.calls[n]
            scene.answer(n, b"to " + payload)
            finished.add(n)
        elif step == "crash":
            scene.responder.crashed()
        elif step == "cancel":
            scene.responder.cancel([bytes([n]) * 16])
        else:
            scene.clock.now += n
            scene.responder.tick()
    for incoming in asked:
        assert len(incoming.outcome) <= 1
        if incoming.outcome and isinstance(incoming.outcome[0], bytes):
            assert incoming.outcome == [b"to " + incoming.payload]
    waiting = sum(1 for incoming in asked if not incoming.outcome)
    assert (waiting == 0) == (scene.responder.in_flight == 0)


def test_its_numbers_are_told_while_services_get_their_first_requests():
    """The main thread reads them at each look, and a scrape does: neither may fail over it."""
    names = [f"/{number}" for number in range(50)]
    for _ in range(20):
        scene = Scene()
        scene.responder.use(dict.fromkeys(names, scene.client))

        def ask(scene=scene):
            for number, name in enumerate(names):
                scene.ask(b"%016d" % number, service=name)

        meanwhile(ask, lambda scene=scene: (scene.responder.at_work, scene.responder.limits))
        assert scene.responder.at_work == len(scene.responder.limits) == len(names)


def test_a_cancel_service_that_answers_late_is_not_taken_to_have_answered_again():
    """It was given up, and what it stops now might be the next request."""
    scene, stop = interruptible()
    for id in (A, B, C):
        scene.ask(id)
    scene.responder.cancel([A])
    scene.answer(0)
    scene.clock.now += 3.0
    scene.responder.tick()
    scene.responder.cancel([B])
    scene.answer(1)
    stop.calls[0][1](b"ok")
    assert len(scene.client.calls) == 2
    stop.calls[1][1](b"ok")
    assert len(scene.client.calls) == 3
