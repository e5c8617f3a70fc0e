"""Every frame that a robot or a replica with a good certificate may send, damaged by seed.

Ten thousand by day, a million at night. One party that sends them costs nothing but itself:
others' requests are answered, once and rightly, on the links that they had.
"""

from __future__ import annotations

import random
import threading
from collections.abc import Sequence
from dataclasses import dataclass

import pytest

from fogft.errors import FrameError
from fogft.link import batch_frames, frame
from fogft.link.frame import NO_LOAD
from fogft.link.port import Answer
from fogft.link.zenoh.robot.connection import read_reply
from fogft.link.zenoh.robot.link import ZenohLink
from tests.fuzz.mutation import damaged
from tests.hostile.robot import greets, sends, session_at, target
from tests.link.wire_pool import (
    SERVICE,
    Authority,
    Owner,
    ReplicaProcess,
    request_id,
    wait_for,
)
from tests.link.zenoh.robot.test_attempts import SERVICE as ASKED
from tests.link.zenoh.robot.test_attempts import Scene
from tests.nightly import by_day

CASES = by_day(10_000, at_night=1_000_000)
OURS = 1 << 100  # ids of the good robot's requests, which nobody guesses
STAMP = b"seen"


@pytest.mark.timeout(1800)  # at night
def test_a_robot_that_sends_damaged_frames_costs_nobody_else_anything(
    authority: Authority,
    replica: ReplicaProcess,
    good: ZenohLink,
    owner: Owner,
) -> None:
    """Under its flood each request of another robot is answered: none wrong, none lost."""
    files = authority.robot("eve")
    at, done = target(replica.endpoint), threading.Event()
    with session_at(at, files) as session:
        send = sends(session, greets(session, files, at), random.Random(25), at)

        def flood() -> None:
            for _ in range(CASES):
                send()
            done.set()

        threading.Thread(target=flood, daemon=True).start()
        asked = 0
        while not done.wait(0.005):
            asked += good.offer(SERVICE, request_id(OURS + asked), b"x%d" % asked, 30.0)
        wait_for(lambda: good.status().in_flight == 0)
    assert asked > 0
    came = sorted((one.request_id, one.payload) for _, one in owner.answers)
    assert came == [(request_id(OURS + number), b"x%d" % number) for number in range(asked)]
    assert replica.count("failed") == 0
    assert replica.count("malformed") > CASES / 10
    assert good.status().reopened == 0


@dataclass
class Bytes:
    content: bytes

    def to_bytes(self) -> bytes:
        return self.content


@dataclass
class Sample:
    payload: Bytes
    attachment: Bytes | None


@dataclass
class Reply:
    """Stands in for one of Zenoh's."""

    ok: Sample | None
    err: Sample | None = None


def replies(ids: Sequence[bytes], dice: random.Random) -> Reply:
    """Return a damaged answer, refusal or batch to requests."""
    one = dice.choice(ids)
    kind = dice.randrange(4)
    if kind == 0:
        refused = damaged((frame.encode_refusal(STAMP, one, "overloaded"),), dice)
        return Reply(None, Sample(Bytes(refused), None))
    header = frame.encode_answer(STAMP, one, packed=kind == 1)
    payload = b"x\x9c" + dice.randbytes(20)
    if kind == 3:
        header, payload = batch_frames.encode_answers(
            STAMP, [(id, NO_LOAD, b"ok", "") for id in ids[:5]]
        )
        payload = damaged((payload,), dice)
    attachment = Bytes(damaged((header,), dice)) if dice.random() < 0.9 else None
    return Reply(Sample(Bytes(payload), attachment))


@pytest.mark.timeout(1800)
def test_a_replica_that_sends_damaged_answers_ends_each_request_once_at_most() -> None:
    """Nothing but a refusal to read them comes out, and only who was asked is answered."""
    dice, taken = random.Random(25), 0
    for _ in range(CASES // 100):
        scene = Scene()
        scene.attempts.packs = scene.attempts.packs_answers = True
        ids = [request_id(dice.randrange(1 << 64)) for _ in range(20)]
        for id in ids:
            assert scene.attempts.offer(ASKED, id, b"x", 60.0)
        for _ in range(100):
            try:
                stamp, answers, packed = read_reply(replies(ids, dice))  # type: ignore[arg-type]
            except FrameError:
                continue
            taken += len(answers)
            scene.attempts.heard(stamp, answers, packed=packed)
        scene.close()
        _each_once(scene.answers, ids)
    assert taken > CASES / 20


def _each_once(answers: Sequence[Answer], ids: Sequence[bytes]) -> None:
    ended = [one.request_id for one in answers]
    assert sorted(ended) == sorted(ids)
