"""The outcome at the deadline, and the service on the robot that may answer before."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fogft.errors import RosError
from fogft.model.choices import FallbackSpec
from fogft.model.refusal import Refusal
from fogft.model.spec import OnTimeout, ServiceSpec
from fogft.proxy.robot.dispatcher import Dispatcher
from tests.fakes.proxy import Clock, FakeClient, FakeLink


class Scene:
    """A dispatcher with a fallback, hand-driven."""

    def __init__(self, links: int = 1, *, is_ok=None, trace: bool = False, **fallback: Any) -> None:
        self.clock = Clock()
        self.responses: list[tuple[object, bytes]] = []
        self.local = FakeClient()
        self.spec = ServiceSpec(
            "/s", "std_srvs/srv/SetBool", timeout_s=5.0, on_timeout=OnTimeout.FALLBACK,
            fallback=FallbackSpec("/local", **fallback), trace=trace,
            ok_field="ok" if is_ok else "",
        )  # fmt: skip
        self.wake_at = float("inf")
        self.dispatcher = Dispatcher(
            self.spec,
            lambda handle, payload: self.responses.append((handle, payload)),
            ok_of=lambda _: is_ok,
            wake=self._wake,
            clock=self.clock,
        )
        self.dispatcher.adopt(self.spec, self.local)
        self.links = [FakeLink(slot) for slot in range(links)]
        self.dispatcher.route(self.links)
        self.dispatcher.tick()

    def _wake(self, at: float = 0.0) -> None:
        self.wake_at = min(self.wake_at, at)

    def ask(self, handle: object = "caller") -> None:
        self.dispatcher.submit(b"q", handle)

    def answer(self, slot: int, payload: bytes, n: int = -1) -> None:
        link = self.links[slot]
        self.dispatcher.answered(link, link.reply(payload, n))

    def pass_time(self, seconds: float) -> float:
        self.clock.now += seconds
        return self.dispatcher.tick()

    def count(self, *names: str) -> list[int]:
        report = self.dispatcher.report()
        return [report[name] for name in names]


def test_at_the_deadline_the_fallback_is_asked_and_answers():
    scene = Scene()
    scene.ask()
    scene.pass_time(4.9)
    assert scene.local.calls == []
    scene.pass_time(0.1)
    assert scene.local.calls[0][0] == b"q"
    assert scene.count("pending") == [1]
    scene.local.calls[0][1](b"from here")
    assert scene.responses == [("caller", b"from here")]
    assert scene.count("fallback", "silent", "answered", "pending") == [1, 0, 0, 0]


def test_a_replica_that_answers_after_the_deadline_is_late():
    scene = Scene()
    scene.ask()
    scene.pass_time(5.0)
    scene.answer(0, b"too late")
    scene.local.calls[0][1](b"from here")
    assert scene.responses == [("caller", b"from here")]
    assert scene.count("late") == [1]


def test_raced_after_a_delay_whoever_is_first_answers():
    scene = Scene(after_s=1.0)
    scene.ask(1)
    scene.ask(2)
    assert scene.pass_time(0.5) <= scene.clock.now + 0.5  # when to look next
    assert scene.local.calls == []
    scene.pass_time(0.5)
    scene.local.calls[0][1](b"from here")
    scene.answer(0, b"from afar", n=1)
    scene.local.calls[1][1](b"second")
    assert scene.responses == [(1, b"from here"), (2, b"from afar")]
    assert scene.links[0].forgotten == [scene.links[0].offered[0][1]]
    assert scene.count("fallback", "answered") == [1, 1]


def test_raced_and_not_answered_it_is_awaited_past_the_deadline_and_not_asked_twice():
    scene = Scene(after_s=1.0, limit_s=2.0)
    scene.ask()
    scene.pass_time(1.0)
    scene.pass_time(4.0)
    assert len(scene.local.calls) == 1
    scene.local.calls[0][1](b"at last")
    assert scene.responses == [("caller", b"at last")]


@pytest.mark.parametrize("after_s", [0.5, None])
def test_a_request_that_kills_services_is_left_to_the_fallback_which_is_asked_once(after_s):
    """At once when it is given up, unless it was asked before."""
    scene = Scene(after_s=after_s, limit_s=2.0)
    scene.ask()
    scene.pass_time(1.0)
    assert len(scene.local.calls) == (0 if after_s is None else 1)
    [link] = scene.links
    for _ in range(2):
        scene.dispatcher.answered(link, link.refusal(Refusal.CRASHED))
        scene.pass_time(0.1)
    assert len(scene.local.calls) == 1
    scene.local.calls[0][1](b"from here")
    assert scene.responses == [("caller", b"from here")]
    assert scene.count("fallback", "poison", "silent", "pending") == [1, 0, 0, 0]
    assert scene.dispatcher.report()["poisoned_at"] is not None


def test_what_killed_services_and_has_no_fallback_either_is_no_silence():
    scene = Scene()
    scene.local.there = False
    scene.ask()
    for _ in range(2):
        scene.dispatcher.answered(scene.links[0], scene.links[0].refusal(Refusal.CRASHED))
        scene.pass_time(0.1)
    assert scene.count("fallback", "poison", "silent", "pending") == [0, 1, 0, 0]


def test_at_once_while_no_replica_is_ready():
    scene = Scene(links=0, while_none_ready=True)
    scene.ask()
    assert scene.wake_at <= scene.clock()
    scene.pass_time(0.0)
    scene.local.calls[0][1](b"from here")
    assert scene.responses == [("caller", b"from here")]


def test_when_the_last_replica_goes_what_it_had_is_answered_here():
    scene = Scene(while_none_ready=True)
    scene.ask()
    scene.pass_time(0.1)
    assert scene.local.calls == []
    scene.dispatcher.route([])
    scene.pass_time(0.0)
    assert len(scene.local.calls) == 1


def test_a_fallback_that_is_not_there_leaves_silence_and_is_counted(caplog):
    scene = Scene()
    scene.local.there = False
    scene.ask()
    scene.pass_time(5.0)
    assert scene.responses == []
    assert scene.count("silent", "fallback_failed", "pending") == [1, 1, 0]
    assert "fallback_not_asked service=/s reason='no node offers it'" in caplog.text


def test_a_fallback_that_hangs_leaves_silence_after_its_own_time():
    scene = Scene(limit_s=2.0)
    scene.ask()
    scene.pass_time(5.0)
    scene.pass_time(1.9)
    assert scene.count("silent", "pending") == [0, 1]
    scene.pass_time(0.2)
    scene.local.calls[0][1](b"much too late")
    assert scene.responses == []
    assert scene.count("silent", "pending") == [1, 0]


def test_a_rejection_is_returned_where_the_fallback_has_nothing_better():
    scene = Scene(is_ok=lambda payload: payload != b"bad")
    scene.ask()
    scene.links.append(FakeLink(1))
    scene.dispatcher.route(scene.links)
    scene.answer(0, b"bad")
    scene.pass_time(5.0)
    scene.local.calls[0][1](b"bad")
    assert scene.responses == [("caller", b"bad")]
    assert scene.count("answered", "fallback_failed") == [1, 1]


def test_an_error_of_ros_is_no_error_of_ours():
    scene = Scene()
    scene.local.broken = RosError("closed")
    scene.ask()
    scene.pass_time(5.0)
    assert scene.count("silent") == [1]


def test_a_trace_says_who_won_and_who_was_asked():
    scene = Scene(2, trace=True)
    scene.ask()
    scene.clock.now += 0.25
    scene.answer(1, b"r")
    scene.ask()
    scene.pass_time(5.0)
    scene.local.calls[0][1](b"r")
    first, second = scene.dispatcher.trace()
    assert (first["outcome"], first["replica"], first["took_s"]) == ("answered", "1.1", 0.25)
    assert first["asked"] == {"0.1": 0.0, "1.1": 0.0}
    assert (second["outcome"], second["replica"]) == ("fallback", "")
    assert scene.dispatcher.trace() == []


def test_a_trace_of_what_expired_says_who_was_asked_and_who_refused():
    """Also where nobody works on it any more: its replicas drop it at the deadline themselves."""
    scene = Scene(2, trace=True)
    scene.ask()
    for link, reason in zip(scene.links, ("expired", "lost"), strict=True):
        scene.clock.now += 1
        scene.dispatcher.answered(link, link.refusal(reason))
    scene.links[1].room = 0  # so that it is never asked again
    scene.pass_time(3.0)
    scene.local.calls[0][1](b"r")
    [line] = scene.dispatcher.trace()
    assert line["outcome"] == "fallback"
    assert line["asked"] == {"0.1": 0.0, "1.1": 0.0}
    assert line["refused"] == {"0.1": "expired", "1.1": "lost"}


def test_a_trace_leaves_out_who_had_no_room():
    scene = Scene(2, trace=True)
    scene.links[1].room = 0
    scene.ask()
    scene.answer(0, b"r")
    [line] = scene.dispatcher.trace()
    assert line["asked"] == {"0.1": 0.0}


def test_what_is_turned_away_is_in_the_trace():
    scene = Scene(trace=True)
    scene.dispatcher.max_pending_bytes = 0
    scene.ask()
    [line] = scene.dispatcher.trace()
    assert (line["outcome"], line["asked"], line["refused"]) == ("turned_away", {}, {})


def test_without_a_trace_nothing_is_kept():
    scene = Scene()
    scene.ask()
    scene.answer(0, b"r")
    assert scene.dispatcher.trace() == []


steps = st.lists(
    st.one_of(
        st.tuples(st.just("ask"), st.just(0.0)),
        st.tuples(st.just("replica"), st.integers(0, 5)),
        st.tuples(st.just("local"), st.integers(0, 5)),
        st.tuples(st.just("pass"), st.floats(0.01, 3.0)),
        st.tuples(st.just("go"), st.just(0)),
        st.tuples(st.just("come"), st.just(0)),
        st.tuples(st.just("drop the fallback"), st.just(0)),
        st.tuples(st.just("its service goes"), st.just(0)),
    ),
    max_size=40,
)


@settings(deadline=None)
@given(steps, st.none() | st.floats(0.1, 4.0), st.booleans())
def test_every_request_ends_once_and_is_handed_to_the_fallback_once(steps, after_s, at_once):
    scene = Scene(after_s=after_s, while_none_ready=at_once)
    asked = 0
    for step, value in steps:
        if step == "ask":
            asked += 1
            scene.ask(asked)
        elif step == "replica" and scene.links[0].offered:
            scene.answer(0, b"far", n=value % len(scene.links[0].offered))
        elif step == "local" and scene.local.calls:
            scene.local.calls[value % len(scene.local.calls)][1](b"here")
        elif step == "pass":
            scene.pass_time(value)
        elif step == "go":
            scene.dispatcher.route([])
        elif step == "come":
            scene.dispatcher.route(scene.links)
        elif step == "drop the fallback":
            plain = ServiceSpec("/s", scene.spec.type, timeout_s=5.0)
            scene.dispatcher.adopt(plain, None)
        elif step == "its service goes":
            scene.local.there = False
    scene.pass_time(5.0)
    scene.pass_time(5.0)
    handles = [handle for handle, _ in scene.responses]
    assert len(handles) == len(set(handles))
    received, *ends = scene.count("received", "answered", "fallback", "silent", "empty")
    assert received == asked == sum(ends)
    assert len(handles) == ends[0] + ends[1]
    assert len(scene.local.calls) <= asked
    assert scene.count("pending", "pending_bytes") == [0, 0]


def test_another_fallback_is_asked_at_the_deadline_for_what_the_old_one_has():
    """The old one's client is closed: its answer never comes."""
    scene, other = Scene(after_s=1.0, limit_s=2.0), FakeClient()
    scene.ask()
    scene.pass_time(1.1)
    assert len(scene.local.calls) == 1
    scene.dispatcher.adopt(scene.spec, other)
    scene.pass_time(4.0)
    [(_, on_response)] = other.calls
    on_response(b"a")
    assert [payload for _, payload in scene.responses] == [b"a"]
