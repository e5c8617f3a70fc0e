"""The probes of a link: whose answers count, what they say, and how long silence has lasted."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import WireError
from fogft.link import probe_frames
from fogft.link.port import Peer, Probe, ProbeAnswer
from fogft.link.zenoh.robot.probing import Probing
from fogft.model.replica import DOUBTED_AFTER_S, ReplicaId
from fogft.model.type_definition import Definition
from tests.link.wire_pool import POOL_UID

PEER = Peer(ReplicaId(POOL_UID, 2, 3), "127.0.0.1:7447", "replica")
ANSWER = ProbeAnswer(slot=2, generation=3, incarnation="first", ready=frozenset({"/s"}))
TYPES = {"std_srvs/srv/SetBool": Definition("hash")}


class Wire:
    """A connection that keeps what it is given to send."""

    def __init__(self) -> None:
        self.heard: list[Callable[[bytes], None]] = []

    def probe(self, key: str, payload: bytes, heard: Callable[[bytes], None]) -> None:
        assert probe_frames.decode_probe(payload).robot == "r"
        self.heard.append(heard)

    def answer(self, answer: ProbeAnswer = ANSWER) -> None:
        self.heard[-1](probe_frames.encode_probe_answer(answer))


class Scene:
    """Probes to one replica, over connections that the test plays."""

    def __init__(self) -> None:
        self.came = 0
        self.probing = Probing(PEER, self._count)
        self.wire: Any = Wire()

    def _count(self) -> None:
        self.came += 1

    def ask(self, now: float = 0.0) -> None:
        self.probing.ask(self.wire, Probe("r"), now)

    def take(self) -> list[ProbeAnswer]:
        return [self.probing.take(heard) for heard in self.probing.heard(self.wire)]


def test_an_answer_is_told_of_kept_and_ends_the_silence():
    scene = Scene()
    assert scene.probing.answer is scene.probing.heard_at is scene.probing.rtt_s is None
    scene.ask(1.0)
    assert (scene.probing.silent_s(3.0), scene.probing.unheard_s(3.0)) == (2.0, 2.0)
    scene.wire.answer()
    assert scene.came == 1
    assert scene.take() == [ANSWER] == [scene.probing.answer]
    assert scene.take() == []
    assert (scene.probing.silent_s(9.0), scene.probing.unheard_s(9.0)) == (0.0, 0.0)
    assert scene.probing.heard_at - 1.0 == scene.probing.rtt_s


def test_what_another_connection_brings_does_not_count():
    scene = Scene()
    scene.ask()
    scene.wire.answer()
    scene.wire = Wire()
    scene.probing.another_connection()
    assert scene.take() == []
    assert scene.probing.answer is None
    assert scene.probing.unheard_s(2.0) == 0.0, "nothing was asked there yet"
    assert scene.probing.silent_s(2.0) == 2.0, "the replica has said nothing since"


@pytest.mark.parametrize("other", [replace(ANSWER, slot=1), replace(ANSWER, generation=4)])
def test_another_replica_is_told_from_the_right_one(other):
    scene = Scene()
    scene.ask()
    scene.wire.answer(other)
    with pytest.raises(
        WireError, match=rf"identifies itself as {other.slot}\.{other.generation}, not"
    ):
        scene.take()
    assert scene.probing.answer is None
    assert scene.probing.silent_s(1.0) == 1.0


@given(st.binary(max_size=64))
def test_noise_is_no_answer(noise):
    scene = Scene()
    scene.ask()
    scene.wire.heard[-1](noise)
    with pytest.raises(WireError, match=r"127\.0\.0\.1:7447` answers probes with"):
        scene.take()
    assert scene.probing.silent_s(1.0) == 1.0


def test_types_are_kept_while_the_same_process_answers():
    scene = Scene()
    told = replace(ANSWER, types=TYPES)
    again = replace(ANSWER, in_flight=1)
    other = replace(ANSWER, incarnation="second")
    for answer, expected in ((told, TYPES), (again, TYPES), (other, {}), (again, {})):
        scene.ask()
        scene.wire.answer(answer)
        assert [taken.types for taken in scene.take()] == [expected]


def test_silence_begins_once_and_leaves_out_what_is_excused():
    scene = Scene()
    scene.probing.nobody_to_ask(1.0)
    scene.ask(2.0)
    scene.ask(3.0)
    assert (scene.probing.silent_s(4.0), scene.probing.unheard_s(4.0)) == (3.0, 2.0)
    scene.probing.excuse(1.5, 4.0)
    assert (scene.probing.silent_s(4.0), scene.probing.unheard_s(4.0)) == (1.5, 0.5)


def test_a_late_answer_is_told_once_a_silence():
    scene, after = Scene(), DOUBTED_AFTER_S
    assert scene.probing.late(0.0) == (False, math.inf)
    for began in (10.0, 20.0):
        scene.ask(began)
        told = [scene.probing.late(began + s) for s in (after / 2, after * 1.5, after * 2)]
        assert [late for late, _ in told] == [False, True, False]
        assert told[0][1] == pytest.approx(after / 2)
        assert [left_s for _, left_s in told[1:]] == [math.inf, math.inf]
        scene.wire.answer()
        assert scene.take()
        scene.probing.rtt_s = 0.0  # the test's clock is not the process's
        assert scene.probing.late(began + 3 * after) == (False, math.inf)
