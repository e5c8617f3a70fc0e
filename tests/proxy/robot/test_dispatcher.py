"""One service on the robot: all replicas are asked, the first success is returned."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import RosError
from fogft.model.cdr import Shape
from fogft.model.refusal import Refusal
from fogft.model.spec import HedgingMode, OnTimeout, Part, ServiceSpec
from fogft.proxy.robot.dispatcher import MALFORMED_LIMIT, Dispatcher
from fogft.proxy.robot.sending import key_of
from fogft.requests.load import Handling
from fogft.requests.pending import LOOK_AGAIN_S
from tests.fakes.proxy import Clock, FakeLink

ALL = HedgingMode.ALL


class Scene:
    """A dispatcher, its clock, its links and what the caller received."""

    def __init__(self, links: int = 2, **spec) -> None:
        self.clock = Clock()
        self.responses: list[tuple[object, bytes]] = []
        self.looks: list[tuple[float, ...]] = []  # when it asked for one: at once is ()
        options = {
            key: spec.pop(key)
            for key in ("empty_response", "fault_of", "max_pending_bytes")
            if key in spec
        }
        if (is_ok := spec.pop("is_ok", None)) is not None:
            spec["ok_field"] = "ok"
            options["ok_of"] = {"ok": is_ok}.__getitem__
        self.dispatcher = Dispatcher(
            ServiceSpec("/s", "std_srvs/srv/SetBool", timeout_s=5.0, **{"hedging": ALL, **spec}),
            lambda handle, payload: self.responses.append((handle, payload)),
            wake=lambda *at: self.looks.append(at),
            clock=self.clock,
            **options,
        )
        self.links = [FakeLink(slot) for slot in range(links)]
        self.dispatcher.route(self.links)

    def answer(self, slot: int, payload: bytes, n: int = -1) -> None:
        link = self.links[slot]
        self.dispatcher.answered(link, link.reply(payload, n))

    def refuse(self, slot: int, reason: str, n: int = -1) -> None:
        link = self.links[slot]
        self.dispatcher.answered(link, link.refusal(reason, n))

    def pass_time(self, seconds: float) -> None:
        self.clock.now += seconds
        self.dispatcher.tick()


def test_every_replica_gets_the_request_under_one_id():
    scene = Scene(3)
    scene.dispatcher.submit(b"q", "caller")
    offers = [link.offered[0] for link in scene.links]
    assert len({request for _, request, _, _ in offers}) == 1
    assert all((name, payload) == ("/s", b"q") for name, _, payload, _ in offers)


@pytest.mark.parametrize(
    ("thin", "size", "hedging", "copies"),
    [
        ((True, True, True), 100_000, HedgingMode.AUTO, 1),
        ((True, True, True), 1_000, HedgingMode.AUTO, 3),
        ((True, False, True), 100_000, HedgingMode.AUTO, 3),  # one replica is far, not the uplink
        ((True, True, True), 100_000, ALL, 3),
    ],
)
def test_over_a_thin_uplink_what_is_large_is_copied_only_if_the_pool_file_says_so(
    thin, size, hedging, copies
):
    scene = Scene(3, hedging=hedging)
    scene.pass_time(60.0)
    scene.dispatcher.submit(b"q", "first")  # all are tried
    scene.answer(0, b"a")
    for link in scene.links[1:]:
        scene.dispatcher.late(link, link.reply(b"a"))
    for link, drains_slowly in zip(scene.links, thin, strict=True):
        link.thin = drains_slowly
    scene.dispatcher.submit(bytes(size), "caller")
    assert sum(len(link.offered) for link in scene.links) == 3 + copies


def test_a_burst_waits_for_its_end_on_every_link_and_no_longer():
    scene = Scene(2)
    scene.dispatcher.burst(True)
    for number in range(3):
        scene.dispatcher.submit(b"q", number)
    assert [link.waits for link in scene.links] == [3, 3]
    scene.dispatcher.burst(False)
    assert [link.waits for link in scene.links] == [0, 0]
    scene.dispatcher.submit(b"q", "alone")
    assert [link.waits for link in scene.links] == [0, 0]
    assert [len(link.offered) for link in scene.links] == [4, 4]


def test_the_first_answer_is_returned_and_the_second_is_late():
    scene = Scene()
    scene.dispatcher.submit(b"q", "caller")
    scene.answer(1, b"fast")
    scene.answer(0, b"slow")
    assert scene.responses == [("caller", b"fast")]
    assert scene.dispatcher.report()["late"] == 1
    assert scene.dispatcher.outcomes.of[key_of(scene.links[1])].won == 1


def test_bytes_of_requests_and_of_first_answers_are_counted():
    scene = Scene()
    for payload in (b"four", b"q"):
        scene.dispatcher.submit(payload, "caller")
    scene.answer(1, b"three", 0)
    scene.answer(0, b"late ones do not count", 0)
    report = scene.dispatcher.report()
    assert (report["request_bytes"], report["response_bytes"]) == (5, 5)


def test_losers_are_told_to_forget():
    scene = Scene(3)
    scene.dispatcher.submit(b"q", "caller")
    scene.answer(1, b"fast")
    request = scene.links[0].offered[0][1]
    assert [link.forgotten for link in scene.links] == [[request], [], [request]]


def test_two_requests_never_share_an_answer():
    scene = Scene(1)
    scene.dispatcher.submit(b"one", "first")
    scene.dispatcher.submit(b"two", "second")
    scene.answer(0, b"answer two", n=1)
    scene.answer(0, b"answer one", n=0)
    assert scene.responses == [("second", b"answer two"), ("first", b"answer one")]


def test_a_refusal_waits_for_the_other_replica():
    scene = Scene()
    scene.dispatcher.submit(b"q", "caller")
    scene.refuse(0, Refusal.CRASHED)
    assert scene.responses == []
    scene.answer(1, b"good")
    assert scene.responses == [("caller", b"good")]


def test_when_all_refuse_the_request_is_tried_again():
    scene = Scene()
    scene.dispatcher.submit(b"q", "caller")
    scene.refuse(0, Refusal.OVERLOADED)
    scene.refuse(1, Refusal.NOT_READY)
    scene.pass_time(0.02)
    assert [len(link.offered) for link in scene.links] == [2, 2]
    scene.answer(0, b"late but good")
    assert scene.responses == [("caller", b"late but good")]


def test_a_request_over_which_two_services_died_is_sent_nowhere_any_more(caplog):
    """The second time it runs alone, so that nothing beside it is blamed; then it has ended."""
    scene = Scene(3, hedging=HedgingMode.FAILOVER)
    scene.dispatcher.submit(b"poison", "caller")
    scene.refuse(0, Refusal.CRASHED)
    scene.pass_time(0.02)
    scene.refuse(1, Refusal.CRASHED)
    scene.pass_time(1.0)
    assert [len(link.offered) for link in scene.links] == [1, 1, 0]
    assert [link.handled[0] for link in scene.links[:2]] == [Handling.NORMAL, Handling.ALONE]
    report = scene.dispatcher.report()
    assert (report["poison"], report["silent"], report["pending"]) == (1, 0, 0)
    assert report["poisoned_at"] == pytest.approx(time.time(), abs=60.0)
    id = scene.links[0].offered[0][1].hex()
    named = f"request_poison service=/s type=std_srvs/srv/SetBool deaths=2 request={id}"
    assert named in caplog.text


def test_after_a_death_no_request_is_at_all_replicas_at_once():
    """Another one that kills could take the whole pool down; a minute later all have each again."""
    scene = Scene(3)
    scene.dispatcher.submit(b"poison", "caller")
    scene.refuse(0, Refusal.CRASHED)
    scene.dispatcher.submit(b"q", "other")
    scene.pass_time(0.1)
    assert sorted(len(link.offered) for link in scene.links) == [1, 1, 2]
    scene.pass_time(60.0)
    before = [len(link.offered) for link in scene.links]
    scene.dispatcher.submit(b"q", "third")
    assert [len(link.offered) for link in scene.links] == [n + 1 for n in before]


@pytest.mark.parametrize("part", [Part.GOAL, Part.RESULT])
def test_what_waits_for_a_goal_is_not_blamed_for_a_death(part):
    scene = Scene(1, part=part)
    scene.dispatcher.submit(b"result", "caller")
    for _ in range(2):
        scene.refuse(0, Refusal.CRASHED)
        scene.pass_time(0.1)
    assert scene.dispatcher.report()["poison"] == 0
    assert len(scene.links[0].offered) == 3


@pytest.mark.parametrize("reason", [Refusal.FORGOTTEN, Refusal.MALFORMED])
def test_a_replica_that_cannot_answer_is_not_asked_again(reason):
    scene = Scene(1)
    scene.dispatcher.submit(b"q", "caller")
    scene.refuse(0, reason)
    scene.pass_time(0.02)
    assert len(scene.links[0].offered) == 1


def test_a_full_window_is_passed_over_and_tried_later():
    scene = Scene(1)
    scene.links[0].room = 0
    scene.dispatcher.submit(b"q", "caller")
    scene.links[0].room = 1
    scene.pass_time(0.02)
    scene.answer(0, b"good")
    assert scene.responses == [("caller", b"good")]


def test_what_has_no_room_at_the_one_replica_goes_to_another_at_once():
    """Under `failover` it would else be offered to that one until its deadline."""
    scene = Scene(3, hedging=HedgingMode.FAILOVER)
    scene.links[0].room = scene.links[1].room = 0
    scene.dispatcher.submit(b"q", "caller")
    assert scene.looks[-1] == (scene.clock.now + LOOK_AGAIN_S,)
    for _ in range(2):
        scene.pass_time(LOOK_AGAIN_S)
    scene.answer(2, b"good")
    scene.dispatcher.submit(b"q", "next")
    scene.answer(2, b"good")
    assert scene.responses == [("caller", b"good"), ("next", b"good")]


def test_a_request_waits_for_the_first_replica_to_come():
    scene = Scene(0)
    scene.dispatcher.submit(b"q", "caller")
    link = FakeLink(0)
    scene.links.append(link)
    scene.dispatcher.route([link])
    scene.answer(0, b"good")
    assert scene.responses == [("caller", b"good")]


def test_what_was_learned_of_a_replica_is_kept_while_it_is_a_member_and_no_longer():
    """One that is away for a moment is known again; of months of replacements nothing piles up."""
    scene = Scene(links=1, hedging=HedgingMode.AUTO)
    away = scene.links[0].peer.id
    scene.dispatcher.submit(b"ask", 0)
    scene.answer(0, b"answer")
    for generation in range(1, 30):
        link = FakeLink(1, generation=generation)
        scene.links = [link]
        scene.dispatcher.route([link], {away: "1", link.peer.id: "1"})
        scene.dispatcher.submit(b"ask", generation)
        scene.answer(0, b"answer")
        learned = scene.dispatcher.report()["hedging"]["replicas"]
        assert set(learned) == {"0.1", link.peer.id.short}
    scene.dispatcher.route([link], {link.peer.id: "1"})
    assert set(scene.dispatcher.report()["hedging"]["replicas"]) == {"1.29"}


def test_a_reopened_link_gets_what_was_in_flight_under_the_same_id():
    scene = Scene(2)
    scene.dispatcher.submit(b"q", "caller")
    scene.refuse(0, Refusal.LOST)
    scene.dispatcher.route(scene.links[1:])
    scene.dispatcher.route(scene.links)
    first, again = scene.links[0].offered
    assert first[1] == again[1]


def test_remaining_time_shrinks_when_a_request_is_sent_again():
    scene = Scene(1)
    scene.dispatcher.submit(b"q", "caller")
    scene.refuse(0, Refusal.LOST)
    scene.pass_time(2.0)
    assert scene.links[0].offered[1][3] == pytest.approx(3.0)


def test_the_default_at_the_deadline_is_silence_and_it_is_counted(caplog):
    scene = Scene()
    scene.dispatcher.submit(b"q", "caller")
    scene.pass_time(5.0)
    scene.answer(0, b"too late")
    assert scene.responses == []
    report = scene.dispatcher.report()
    assert (report["silent"], report["late"], report["pending"]) == (1, 1, 0)
    assert "request_timed_out service=/s outcome=silent" in caplog.text


def test_empty_at_the_deadline_where_the_pool_file_says_so():
    scene = Scene(on_timeout=OnTimeout.EMPTY, empty_response=b"empty")
    scene.dispatcher.submit(b"q", "caller")
    scene.pass_time(5.0)
    assert scene.responses == [("caller", b"empty")]
    assert scene.dispatcher.report()["empty"] == 1


def not_bad(payload: bytes) -> bool:
    return not payload.startswith(b"bad")


def test_a_response_that_is_not_ok_waits_for_a_better_one():
    scene = Scene(is_ok=not_bad)
    scene.dispatcher.submit(b"q", "caller")
    scene.answer(0, b"bad")
    assert scene.responses == []
    scene.answer(1, b"good")
    assert scene.responses == [("caller", b"good")]


def test_a_response_that_is_not_ok_is_returned_when_nothing_better_can_come():
    scene = Scene(is_ok=not_bad)
    scene.dispatcher.submit(b"q", "caller")
    scene.answer(0, b"bad 0")
    scene.answer(1, b"bad 1")
    assert scene.responses == [("caller", b"bad 1")]


def test_a_response_that_is_not_ok_beats_silence_at_the_deadline():
    scene = Scene(is_ok=not_bad)
    scene.dispatcher.submit(b"q", "caller")
    scene.answer(0, b"bad")
    scene.pass_time(5.0)
    assert scene.responses == [("caller", b"bad")]


def test_pending_bytes_are_bounded(caplog: pytest.LogCaptureFixture):
    """And whoever asks for more is told the limit."""
    scene = Scene(1, max_pending_bytes=10)
    for _ in range(3):
        scene.dispatcher.submit(b"12345", "caller")
    report = scene.dispatcher.report()
    assert (report["turned_away"], report["pending_bytes"]) == (1, 10)
    assert "5 B, beside 10 B of 2: at most 10 B" in caplog.text
    scene.answer(0, b"a", n=0)
    assert scene.dispatcher.report()["pending_bytes"] == 5


def test_pending_requests_are_bounded_however_small():
    scene = Scene(1)
    scene.dispatcher.max_pending = 2
    for _ in range(3):
        scene.dispatcher.submit(b"", "caller")
    assert scene.dispatcher.report()["turned_away"] == 1
    scene.answer(0, b"a", n=0)
    scene.dispatcher.submit(b"", "caller")
    assert scene.dispatcher.report()["turned_away"] == 1


def test_a_full_window_is_tried_again_while_a_frozen_replica_works_on_the_request():
    """What only a frozen replica took must not wait until that one is suspected."""
    scene = Scene()
    scene.links[1].room = 0
    scene.dispatcher.submit(b"q", "caller")
    scene.links[1].room = 1
    scene.pass_time(0.02)
    scene.answer(1, b"good")
    assert scene.responses == [("caller", b"good")]


def test_an_overloaded_replica_is_asked_again_while_a_frozen_one_works_on_the_request():
    scene = Scene()
    scene.dispatcher.submit(b"q", "caller")
    scene.refuse(1, Refusal.OVERLOADED)
    scene.pass_time(0.02)
    scene.answer(1, b"good")
    assert scene.responses == [("caller", b"good")]


def test_a_replica_that_comes_is_asked_what_a_frozen_one_works_on():
    scene = Scene(1)
    scene.dispatcher.submit(b"q", "caller")
    scene.links.append(FakeLink(1))
    scene.dispatcher.route(scene.links)
    scene.answer(1, b"good")
    assert scene.responses == [("caller", b"good")]


def test_a_response_that_ros_does_not_take_harms_no_other_request():
    """A client that is frozen, or gone, must end neither the thread of a link nor the proxy."""

    def respond(handle: object, payload: bytes) -> None:
        raise RosError("its queue is full")

    dispatcher = Dispatcher(
        ServiceSpec("/s", "std_srvs/srv/SetBool", timeout_s=5.0, on_timeout=OnTimeout.EMPTY),
        respond,
        empty_response=b"empty",
        clock=(clock := Clock()),
    )
    links = [FakeLink(0), FakeLink(1)]
    dispatcher.route(links)
    dispatcher.submit(b"q", "caller")
    dispatcher.answered(links[0], links[0].reply(b"r"))
    assert links[1].forgotten
    dispatcher.submit(b"q", "caller")
    clock.now += 5.0
    dispatcher.tick()
    assert dispatcher.report()["undelivered"] == 2


def test_an_answer_that_is_no_response_of_the_type_is_a_failure():
    def is_ok(payload: bytes) -> bool:
        if payload == b"garbage":
            raise RosError("no response")
        return True

    scene = Scene(is_ok=is_ok)
    scene.dispatcher.submit(b"q", "caller")
    scene.answer(0, b"garbage")
    scene.answer(1, b"good")
    assert scene.responses == [("caller", b"good")]


def test_a_request_that_is_answered_while_it_is_offered_is_forgotten_by_the_rest():
    """An answer can come before the last link has the request: that one need not work on it."""
    scene = Scene()
    offer = scene.links[0].offer

    def answered_at_once(*arguments, **options):
        offer(*arguments, **options)
        scene.answer(0, b"fast")
        return True

    scene.links[0].offer = answered_at_once  # type: ignore[method-assign]
    scene.dispatcher.submit(b"q", "caller")
    assert scene.links[1].offered[0][1] == scene.links[1].forgotten[-1]


def test_two_generations_of_a_slot_are_two_replicas():
    """While a replacement takes over, a refusal of the old one is not one of the new."""
    scene = Scene(0)
    scene.links = [FakeLink(0, generation=1), FakeLink(0, generation=2)]
    scene.dispatcher.route(scene.links)
    scene.dispatcher.submit(b"q", "caller")
    scene.refuse(0, Refusal.FORGOTTEN)
    scene.answer(1, b"good")
    assert scene.responses == [("caller", b"good")]


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["submit", "answer", "refuse", "lose", "pass"]), st.integers(0, 2)
        ),
        max_size=60,
    )
)
def test_each_caller_is_answered_at_most_once_and_nothing_is_lost(steps):
    """Whatever happens: received = answered + silent + pending, and no caller hears twice."""
    scene = Scene(3)
    callers = 0
    for step, slot in steps:
        link = scene.links[slot]
        if step == "submit":
            callers += 1
            scene.dispatcher.submit(b"q%d" % callers, callers)
        elif step == "pass":
            scene.pass_time(slot + 0.5)
        elif link.offered:
            if step == "answer":
                _, _, payload, _ = link.offered[-1]
                scene.answer(slot, b"to " + payload)
            else:
                scene.refuse(slot, Refusal.LOST if step == "lose" else Refusal.CRASHED)
    report = scene.dispatcher.report()
    assert (
        report["received"]
        == report["answered"] + report["silent"] + report["poison"] + report["pending"]
    )
    handles = [handle for handle, _ in scene.responses]
    assert len(handles) == len(set(handles)) == report["answered"]
    assert all(payload == b"to q%d" % handle for handle, payload in scene.responses)


def test_a_changed_ok_field_counts_from_the_next_answer_on():
    """Requests under way end by the check of now, and none is lost to the change."""
    checks = {"ok": lambda payload: payload != b"bad", "fine": lambda payload: payload != b"poor"}
    responses: list[tuple[object, bytes]] = []
    spec = ServiceSpec("/s", "std_srvs/srv/SetBool", timeout_s=5.0)
    dispatcher = Dispatcher(
        spec, lambda *response: responses.append(response), ok_of=checks.__getitem__, clock=Clock()
    )
    links = [FakeLink(0), FakeLink(1)]
    dispatcher.route(links)
    for field, rejected in (("ok", b"bad"), ("fine", b"poor"), ("", b"")):
        dispatcher.adopt(replace(spec, ok_field=field))
        dispatcher.submit(b"q", field)
        if rejected:
            dispatcher.answered(links[0], links[0].reply(rejected))
        dispatcher.answered(links[1], links[1].reply(b"good" if field else b"bad"))
    assert responses == [("ok", b"good"), ("fine", b"good"), ("", b"bad")]


def test_an_answer_that_came_as_the_ok_field_changed_is_no_rejection():
    """It was taken before there was one, and is judged after."""
    now, changes, responses = Clock(), list[Callable[[], None]](), []

    def clock() -> float:
        while changes:
            changes.pop()()
        return now()

    spec = ServiceSpec("/s", "std_srvs/srv/SetBool", timeout_s=5.0)
    checks = {"ok": lambda payload: payload == b"good"}
    dispatcher = Dispatcher(
        spec, lambda *response: responses.append(response), ok_of=checks.__getitem__, clock=clock
    )
    link = FakeLink(0)
    dispatcher.route([link])
    dispatcher.submit(b"q", "caller")
    changes.append(lambda: dispatcher.adopt(replace(spec, ok_field="ok")))
    dispatcher.answered(link, link.reply(b"good"))
    assert responses == [("caller", b"good")]
    assert dispatcher.report()["rejected"] == 0


def test_a_service_may_become_one_that_answers_empty_at_the_deadline():
    scene = Scene(empty_response=b"empty")
    scene.dispatcher.submit(b"q", "before")
    scene.dispatcher.adopt(replace(scene.dispatcher.spec, on_timeout=OnTimeout.EMPTY))
    scene.pass_time(6.0)
    assert scene.responses == [("before", b"empty")]


SET_BOOL = Shape("", {"": (("success", "boolean"), ("message", "string"))})
RIGHT = b"\x00\x01\x00\x00\x01\x00\x00\x00\x01\x00\x00\x00\x00"


@pytest.mark.parametrize("junk", [b"", bytes(4), bytes(11), b"\x2a" * 65_536, bytes(65_536)])
def test_a_malformed_response_never_wins(junk: bytes) -> None:
    """Whoever sends it first: the next response is the answer, and the replica has failed."""
    scene = Scene(3, fault_of=SET_BOOL.fault)
    scene.dispatcher.submit(b"q", "caller")
    scene.answer(0, junk)
    assert scene.responses == []
    scene.answer(1, RIGHT)
    assert scene.responses == [("caller", RIGHT)]
    report = scene.dispatcher.report()
    assert (report["answered"], report["refused"]) == (1, {"malformed": 1})


def test_a_replica_whose_responses_are_malformed_is_to_be_replaced() -> None:
    """After a few of them, and nobody else is."""
    scene = Scene(2, fault_of=SET_BOOL.fault)
    liar, honest = (key_of(link) for link in scene.links)
    for count in range(1, MALFORMED_LIMIT + 1):
        assert not scene.dispatcher.misreads(liar)
        scene.dispatcher.submit(b"q", count)
        scene.answer(0, b"junk")
        scene.answer(1, RIGHT)
    assert scene.dispatcher.misreads(liar)
    assert not scene.dispatcher.misreads(honest)
    assert [handle for handle, _ in scene.responses] == list(range(1, MALFORMED_LIMIT + 1))
