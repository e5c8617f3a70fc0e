"""The requests of one connection, over an outlet that the test plays: each ends once."""

from __future__ import annotations

import threading
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.link import batch_frames, compression, frame
from fogft.link.credit import LARGE_BYTES, LargeSendGate
from fogft.link.port import Answer, SendOptions
from fogft.link.socket_progress import SocketProgress
from fogft.link.zenoh.robot.attempts import Attempts, Callbacks
from fogft.model.refusal import Refusal
from tests.link.wire_pool import request_id, wait_for

SERVICE = "/s"


class Flow:
    """A fast link of which nothing is known."""

    thin = False

    def __init__(self) -> None:
        self.progress = SocketProgress()


class Outlet:
    """What was sent; refuses to send where the test says so."""

    def __init__(self) -> None:
        self.flow: Any = Flow()
        self.fails = False
        self.sent: list[bytes] = []
        self.left_s: list[float] = []  # as the replica is told
        self.lost: list[str] = []

    def publish(self, service: str, content: bytes, header: bytes) -> None:
        if self.fails:
            raise OSError("no way out")
        if header[:1] == batch_frames.BATCH:
            headers = [one for one, _ in batch_frames.decode_requests(header, content)]
        else:
            headers = [frame.decode_request(header)]
        self.sent += [one.request_id for one in headers]
        self.left_s += [one.remaining_s for one in headers]

    def cancel(self, ids: Sequence[bytes]) -> None:
        pass

    def alive(self) -> bool:
        return True

    def lose(self, because: str) -> None:
        self.lost.append(because)


class Scene:
    def __init__(self, options: SendOptions | None = None) -> None:
        self.outlet, self.gate = Outlet(), LargeSendGate()
        self.answers: list[Answer] = []
        self.late: list[bytes] = []
        self.ended = 0
        self.attempts = Attempts(
            self.outlet,
            frozenset({SERVICE}),
            frame.origin("ada", bytes(frame.TOKEN_BYTES)),
            options=options or SendOptions(),
            gate=self.gate,
            tell_losers=True,
            tell=Callbacks(
                answered=self.answers.append,
                late=lambda answer: self.late.append(answer.request_id),
                room=lambda: None,
                wake=lambda: None,
            ),
            ended=self._end,
            name="test-send",
        )

    def _end(self) -> None:
        self.ended += 1

    def close(self) -> None:
        self.attempts.close()
        self.attempts.end()
        wait_for(lambda: self.ended)


steps = st.lists(
    st.one_of(
        st.tuples(
            st.just("offer"),
            st.integers(0, 9),
            st.sampled_from([8, 5000, LARGE_BYTES]),
            st.booleans(),
        ),
        st.tuples(st.sampled_from(["answer", "refuse", "forget"]), st.integers(0, 9)),
        st.tuples(st.sampled_from(["send", "sweep", "fail", "work"])),
    ),
    max_size=40,
)


@given(steps)
def test_each_attempt_that_was_taken_ends_once_unless_it_was_forgotten(steps: list[Any]) -> None:
    """Whatever is sent, fails, is answered twice, comes late, or is open at the end."""
    scene = Scene()
    attempts, taken, forgotten = scene.attempts, Counter[bytes](), Counter[bytes]()
    for what, *rest in steps:
        id = request_id(rest[0]) if rest else b""
        if what == "offer":
            if attempts.offer(SERVICE, id, bytes(rest[1]), 60.0, more=rest[2]):
                taken[id] += 1
        elif what == "answer":
            attempts.heard(b"once", [Answer(id, b"payload")])
        elif what == "refuse":
            attempts.heard(b"once", [Answer(id, None, Refusal.OVERLOADED)])
        elif what == "forget":
            forgotten[id] += id in {one.request_id for one in attempts.window.attempts()}
            attempts.forget(id)
        elif what == "send":
            attempts.send()
        elif what == "sweep":
            attempts.sweep()
        else:
            scene.outlet.fails = what == "fail"
    scene.close()
    told = Counter(answer.request_id for answer in scene.answers)
    # A large one may end by itself, in the sender thread, between our look and our `forget`.
    assert all(taken[id] - forgotten[id] <= told[id] <= taken[id] for id in taken)
    assert told.keys() <= taken.keys()
    assert not attempts.window.attempts()
    assert scene.ended == 1
    assert not attempts.offer(SERVICE, request_id(99), b"x", 60.0)


def test_what_is_small_is_sent_before_offer_returns_and_shows_what_was_seen() -> None:
    scene = Scene()
    scene.attempts.heard(b"seen", [])
    headers: list[frame.RequestHeader] = []
    scene.outlet.publish = lambda service, content, header: headers.append(  # type: ignore[method-assign]
        frame.decode_request(header)
    )
    assert scene.attempts.offer(SERVICE, request_id(1), b"x", 60.0)
    assert [(one.request_id, one.seen) for one in headers] == [(request_id(1), b"seen")]
    scene.close()
    assert [answer.refusal for answer in scene.answers] == [Refusal.LOST]


def test_no_time_left_is_said_as_none_and_not_as_less() -> None:
    """The replica would not know a frame of it, and say nothing."""
    scene = Scene()
    assert scene.attempts.offer(SERVICE, request_id(1), b"x", -1.0)
    assert scene.outlet.sent == [request_id(1)]
    scene.close()


def test_what_cannot_be_sent_ends_at_once_and_takes_the_connection_with_it() -> None:
    scene = Scene()
    scene.outlet.fails = True
    assert scene.attempts.offer(SERVICE, request_id(1), b"x", 60.0)
    assert [answer.refusal for answer in scene.answers] == [Refusal.LOST]
    assert scene.outlet.lost == ["sending failed: no way out"]
    scene.close()
    assert len(scene.answers) == 1


def test_an_answer_after_it_was_forgotten_is_late() -> None:
    scene = Scene()
    assert scene.attempts.offer(SERVICE, request_id(1), b"x", 60.0)
    scene.attempts.forget(request_id(1))
    scene.attempts.heard(b"once", [Answer(request_id(1), b"y")])
    scene.close()
    assert (scene.answers, scene.late) == ([], [request_id(1)])


@pytest.mark.parametrize("waits_for", ["the others of a burst", "the sender", "its turn"])
def test_one_that_was_forgotten_before_it_was_sent_is_late_by_itself(waits_for: str) -> None:
    """The replica never heard of it; without a word its owner would wait for its end for ever."""
    scene = Scene()
    size, more = LARGE_BYTES, False
    if waits_for == "the others of a burst":
        size, more = 1, True
        goes_on = scene.attempts.send
    elif waits_for == "the sender":
        blocked, publish = threading.Event(), scene.outlet.publish
        goes_on = blocked.set
        scene.outlet.publish = lambda *sent: (blocked.wait(20), publish(*sent))  # type: ignore[func-returns-value,method-assign]
    else:
        scene.gate.patience_s = 20.0
        turn = scene.gate.take()
        goes_on = lambda: scene.gate.give(turn)  # noqa: E731
    for number in (1, 2):
        assert scene.attempts.offer(SERVICE, request_id(number), bytes(size), 60.0, more=more)
    forgotten, sent = (1, 2) if waits_for == "its turn" else (2, 1)
    scene.attempts.forget(request_id(forgotten))
    assert scene.late == []
    goes_on()
    wait_for(lambda: scene.outlet.sent == [request_id(sent)])
    wait_for(lambda: scene.late == [request_id(forgotten)])
    scene.close()
    assert scene.late == [request_id(forgotten)]


def test_a_packed_answer_is_unpacked_where_it_was_asked_for() -> None:
    """It ends its attempt as any other does; one that cannot be unpacked is the replica's fault."""
    scene = Scene()
    for number, packed in enumerate((zlib.compress(b"answer"), b"no zlib"), 1):
        assert scene.attempts.offer(SERVICE, request_id(number), b"x", 60.0)
        scene.attempts.heard(b"once", [Answer(request_id(number), packed)], packed=True)
    wait_for(lambda: len(scene.answers) == 2)
    assert {one.request_id: (one.payload, one.refusal) for one in scene.answers} == {
        request_id(1): (b"answer", None),
        request_id(2): (None, Refusal.MALFORMED),
    }
    scene.close()


def test_a_large_answer_keeps_the_thread_of_all_links_for_no_longer_than_a_small_one() -> None:
    """Whoever takes it looks at all of it, which may take seconds."""
    scene, taken = Scene(), threading.Event()

    def slow(answer: Answer) -> None:
        if len(answer.payload or b"") > 100:
            taken.wait(60.0)
        scene.answers.append(answer)

    scene.attempts.tell = replace(scene.attempts.tell, answered=slow)
    for number, size in ((1, 2 << 20), (2, 10)):
        assert scene.attempts.offer(SERVICE, request_id(number), b"x", 60.0)
        scene.attempts.heard(b"once", [Answer(request_id(number), bytes(size))])
    assert [one.request_id for one in scene.answers] == [request_id(2)]
    taken.set()
    wait_for(lambda: len(scene.answers) == 2)
    assert len(scene.answers[1].payload) == 2 << 20
    scene.close()


def test_nothing_is_unpacked_that_was_not_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither for an unknown id, nor for one that is not wanted, nor where no request allows it."""
    monkeypatch.setattr(compression, "unpack", lambda packed: pytest.fail("it was unpacked"))
    scene = Scene(SendOptions(plain=frozenset({SERVICE})))
    bomb = zlib.compress(bytes(1 << 20))
    for number in (1, 2):
        assert scene.attempts.offer(SERVICE, request_id(number), b"x", 60.0)
    scene.attempts.forget(request_id(2))
    for number in (1, 2):
        scene.attempts.heard(b"once", [Answer(request_id(number), bomb)], packed=True)
    assert [one.refusal for one in scene.answers] == [Refusal.MALFORMED]
    assert scene.late == [request_id(2)]
    assert not scene.outlet.lost
    scene.attempts.heard(b"once", [Answer(request_id(3), bomb)], packed=True)
    assert scene.outlet.lost == ["it sends more answers than it received requests"]
    scene.close()


def test_a_replica_has_as_much_less_time_as_the_way_there_and_back_takes():
    """What it ends just in time is here in time; of little time it has half."""
    scene = Scene()
    scene.attempts.round_trip_s = 0.1
    for number, remaining_s in enumerate((10.0, 0.15)):
        scene.attempts.offer(SERVICE, request_id(number), b"q", remaining_s)
    for number in (2, 3):
        scene.attempts.offer(SERVICE, request_id(number), b"q", 10.0, more=number == 2)
    assert scene.outlet.left_s == pytest.approx([9.9, 0.075, 9.9, 9.9], abs=0.02)
    scene.close()
