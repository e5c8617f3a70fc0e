"""Frames: what goes out comes back, and no bytes whatever do harm."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import FrameError
from fogft.link import frame, probe_frames
from fogft.link.port import GatewayView, Probe, ProbeAnswer
from fogft.model.keys import LONGEST_S
from fogft.model.names import NAMES_BYTES_LIMIT
from fogft.model.replica import LinkState
from fogft.model.type_definition import Definition
from fogft.requests.load import Load

LOAD = Load(3, 1, 2, 0.5, 0.25)
LOAD_BYTES = frame.encode_load(LOAD)

ids = st.binary(min_size=16, max_size=16)
tokens = st.binary(min_size=8, max_size=8)
stamps = st.binary(min_size=4, max_size=4)
robots = st.text(st.characters(categories=["L", "N", "P"]), min_size=1, max_size=64).filter(
    lambda name: len(name.encode()) <= frame.ROBOT_BYTES_LIMIT and name.isprintable()
)
remaining = st.floats(0, LONGEST_S, allow_nan=False)
reasons = st.text(st.characters(min_codepoint=32, max_codepoint=126), min_size=1, max_size=64)
texts = st.text(max_size=100).filter(str.isprintable)
counts = st.integers(0, 2**53 - 1)
answers = st.builds(
    ProbeAnswer,
    slot=counts,
    generation=counts,
    incarnation=texts,
    ready=st.frozensets(texts, max_size=8),
    draining=st.booleans(),
    restarts=counts,
    in_flight=counts,
    detail=texts,
    work=st.dictionaries(texts, st.floats(0, 1e9, allow_nan=False), max_size=4),
)
probes = st.builds(Probe, robot=texts, describe=st.booleans())

DECODERS: list[Callable[[bytes], Any]] = [
    frame.decode_request,
    frame.decode_answer,
    frame.decode_refusal,
    probe_frames.decode_probe,
    probe_frames.decode_probe_answer,
    frame.decode_greeting,
    frame.decode_cancel,
]


FLAGS = st.fixed_dictionaries(
    {name: st.booleans() for name in ("packed", "may_pack", "reads_packed")}
)


@given(request_id=ids, remaining_s=remaining, token=tokens, robot=robots, seen=stamps, flags=FLAGS)
def test_a_request_header_comes_back(
    request_id: bytes,
    remaining_s: float,
    token: bytes,
    robot: str,
    seen: bytes,
    flags: dict[str, bool],
) -> None:
    """Decoding undoes encoding."""
    origin = frame.origin(robot, token)
    sent = frame.encode_request(request_id, remaining_s, origin, seen=seen, **flags)
    expected = frame.RequestHeader(request_id, remaining_s, token, robot, seen, **flags)
    assert frame.decode_request(sent) == expected


@given(stamp=stamps, request_id=ids)
def test_an_answer_header_comes_back(stamp: bytes, request_id: bytes) -> None:
    """Decoding undoes encoding."""
    for packed in (False, True):
        header = frame.encode_answer(stamp, request_id, load=LOAD_BYTES, packed=packed)
        assert frame.decode_answer(header) == (stamp, request_id, LOAD, packed)
        header = frame.encode_answer(stamp, request_id, packed=packed)
        assert frame.decode_answer(header) == (stamp, request_id, None, packed)


@given(stamp=stamps, request_id=ids, reason=reasons)
def test_a_refusal_comes_back(stamp: bytes, request_id: bytes, reason: str) -> None:
    """Decoding undoes encoding."""
    sent = frame.encode_refusal(stamp, request_id, reason, LOAD_BYTES)
    assert frame.decode_refusal(sent) == (stamp, request_id, reason, LOAD)


@pytest.mark.parametrize("wrong_s", [-1.0, float("nan"), float("inf"), 1e9])
def test_a_load_with_a_time_that_is_none_is_refused(wrong_s):
    for load in (Load(0, 0, 0, wrong_s, 0.0), Load(0, 0, 0, 0.0, wrong_s)):
        header = frame.encode_answer(frame.NO_STAMP, bytes(16), load=frame.encode_load(load))
        with pytest.raises(FrameError, match="a load of"):
            frame.decode_answer(header)


def test_a_load_beyond_what_fits_is_told_as_the_most():
    told = frame.decode_load(frame.encode_load(Load(10**6, 10**6, 10**6, 0.5, 0.5)))
    assert told == Load(0xFFFF, 0xFF, 0xFF, 0.5, 0.5)


@given(token=tokens, certificate=st.binary(max_size=1500), signature=st.binary(min_size=1))
def test_a_greeting_comes_back(token: bytes, certificate: bytes, signature: bytes) -> None:
    """Decoding undoes encoding; without a certificate the token alone travels."""
    sent = frame.Greeting(token, certificate, signature if certificate else b"")
    assert frame.decode_greeting(frame.encode_greeting(sent)) == sent


@given(cancelled=st.lists(ids, max_size=20))
def test_a_cancellation_comes_back(cancelled: list[bytes]) -> None:
    """Decoding undoes encoding."""
    assert frame.decode_cancel(frame.encode_cancel(cancelled)) == cancelled


@given(probe=probes)
def test_a_probe_comes_back(probe: Probe) -> None:
    """Decoding undoes encoding."""
    assert probe_frames.decode_probe(probe_frames.encode_probe(probe)) == probe


@given(answer=answers)
def test_a_probe_answer_comes_back(answer: ProbeAnswer) -> None:
    """Decoding undoes encoding."""
    assert probe_frames.decode_probe_answer(probe_frames.encode_probe_answer(answer)) == answer


@pytest.mark.parametrize("decode", DECODERS)
@given(garbage=st.binary(max_size=200))
def test_garbage_is_a_frame_error_or_a_frame(
    decode: Callable[[bytes], Any], garbage: bytes
) -> None:
    """Whatever bytes come, a decoder raises nothing but FrameError."""
    try:
        decode(garbage)
    except FrameError:
        return


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@pytest.mark.parametrize("decode", [probe_frames.decode_probe, probe_frames.decode_probe_answer])
@given(data=st.data())
def test_json_of_the_wrong_shape_is_a_frame_error_or_a_frame(
    decode: Callable[[bytes], Any], data: st.DataObject
) -> None:
    """A probe in which any one value is replaced by any JSON at all raises only FrameError."""
    good = {
        "v": 1,
        "robot": "r",
        "describe": True,
        "lease_left_s": 1.0,
        "slot": 0,
        "generation": 1,
        "incarnation": "i",
        "ready": ["/a"],
        "draining": False,
        "restarts": 0,
        "in_flight": 0,
        "detail": "",
    }
    key = data.draw(st.sampled_from(sorted(good)))
    bad = {**good, key: data.draw(json_values)}
    try:
        value = decode(json.dumps(bad).encode())
    except FrameError:
        return
    assert isinstance(value, (Probe, ProbeAnswer))


@pytest.mark.parametrize("impossible", [-1e-9, -1e17, 1e13, 1e999])
@pytest.mark.parametrize("key", ["lease_age_s", "lease_left_s", "work", "behind"])
def test_a_duration_that_cannot_be_is_refused(key: str, impossible: float) -> None:
    """Negative, or longer than any machine lives: nothing is reckoned with it."""
    view = {"slot": 0, "generation": 1, "state": "up", "rtt_s": impossible}
    value = {"work": {"ran": impossible}, "behind": [view]}.get(key, impossible)
    said = {"v": frame.VERSION, "slot": 0, "generation": 1, "incarnation": "i", key: value}
    with pytest.raises(FrameError):
        probe_frames.decode_probe_answer(json.dumps(said).encode())


@given(request_id=ids, cut=st.integers(0, 100), grown=st.binary(max_size=80))
def test_a_header_of_the_wrong_length_is_refused(request_id: bytes, cut: int, grown: bytes) -> None:
    """An answer's header has one length; every other is a FrameError."""
    whole = frame.encode_answer(frame.NO_STAMP, request_id)
    for wrong in {whole[: cut % len(whole)], whole + grown + b"x"}:
        with pytest.raises(FrameError):
            frame.decode_answer(wrong)


@pytest.mark.parametrize("version", [0, 1, 255])
def test_another_version_is_refused(version: int) -> None:
    """A peer of another version is told apart from garbage by its version."""
    request = frame.encode_request(bytes(16), 1.0, frame.origin("r", bytes(8)))
    refusal = frame.encode_refusal(frame.NO_STAMP, bytes(16), "lost")
    for sent, decode in ((request, frame.decode_request), (refusal, frame.decode_refusal)):
        with pytest.raises(FrameError, match=f"version {version}"):
            decode(bytes([version]) + sent[1:])


@pytest.mark.parametrize("remaining_s", [-1.0, math.nan, math.inf, -math.inf, 1e8])
def test_an_impossible_remaining_time_is_refused(remaining_s: float) -> None:
    """A deadline is a number of seconds that can be added to a clock."""
    with pytest.raises(FrameError, match="remaining time"):
        frame.decode_request(frame.encode_request(bytes(16), remaining_s, bytes(8) + b"r"))


@pytest.mark.parametrize(
    "content",
    [
        b"[" * 5000,
        b'{"v":1,"robot":"r","describe":NaN}',
        b'{"v":1,"robot":"r","describe":1e999}',
        b'{"v":1,"robot":"\\ud800"}',
        b'{"v":true,"robot":"r"}',
        b'{"robot":"r"}',
        b"1",
        b" " * 2000 + b'{"v":1,"robot":"r"}',
        b"1" * 900,
    ],
)
def test_a_hostile_probe_is_refused(content: bytes) -> None:
    """Depth, NaN, infinity, lone surrogates, a missing version, too much: all are FrameErrors."""
    with pytest.raises(FrameError):
        probe_frames.decode_probe(content)


@pytest.mark.parametrize("robot", ["", "x" * 65, "a\nb", "\u00e4" * 33])
def test_a_robot_name_that_cannot_travel_is_refused_at_once(robot: str) -> None:
    """The sender learns of it, not the receiver."""
    with pytest.raises(ValueError, match="robot's name"):
        frame.origin(robot, bytes(8))


def test_a_long_detail_is_cut_and_the_answer_still_travels() -> None:
    """Detail is for people; it never costs the probe."""
    answer = ProbeAnswer(slot=0, generation=1, incarnation="i", detail="\ud800" + "x" * 100_000)
    decoded = probe_frames.decode_probe_answer(probe_frames.encode_probe_answer(answer))
    assert len(decoded.detail) == probe_frames.DETAIL_LIMIT


ESCAPES = [
    "\x1b]0;title\x07",
    "\x1b[2J",
    "3 of 3 ready\nrow two",
    "\u202ereversed",
    "\x9b31m",
    "\r",
]


@pytest.mark.parametrize("hostile", [*ESCAPES, "x" * 1000])
def test_what_would_move_a_cursor_is_refused_wherever_it_stands(hostile: str) -> None:
    """A terminal's title, a second line, a reversed text, a wall of it: no name holds one."""
    whole = {
        "slot": 0, "generation": 1, "incarnation": "i", "detail": "d", "ready": ["/s"],
        "work": {"ran": 1.0}, "offered": {"/s": "a/srv/B"}, "accepts": ["lz4"],
        "types": {"a/srv/B": {"trouble": "t", "fields": {"request": [["x", "int32"]]}}},
        "behind": [{"slot": 0, "generation": 1, "state": "up", "detail": "d", "through": "lab"}],
    }  # fmt: skip
    plain = json.dumps({"v": frame.VERSION, **whole})
    assert probe_frames.decode_probe_answer(plain.encode()).detail == "d"
    for text in ('"i"', '"d"', '"/s"', '"ran"', '"a/srv/B"', '"lz4"', '"t"', '"x"', '"lab"'):
        content = plain.replace(text, json.dumps(f"a{hostile}"))
        assert content != plain
        with pytest.raises(FrameError, match=r"cannot be printed|at most 1000"):
            probe_frames.decode_probe_answer(content.encode())


@pytest.mark.parametrize("said", ESCAPES)
def test_what_a_program_prints_travels_as_one_line(said: str) -> None:
    """The end of a log may hold anything: the replica that tells it is not refused for it."""
    answer = ProbeAnswer(slot=0, generation=1, incarnation="i", detail=f"`run` ended: {said}")
    decoded = probe_frames.decode_probe_answer(probe_frames.encode_probe_answer(answer))
    assert decoded.detail.startswith("`run` ended:")
    assert decoded.detail.isprintable()


def test_definitions_that_do_not_fit_are_left_out_and_the_answer_still_travels() -> None:
    """Health never depends on how long a type is."""
    large = {"a/srv/B": Definition("h", {"request": (("x" * 300_000, "int32"),)})}
    small = {"a/srv/B": Definition("h", {"request": (("x", "int32"),)})}
    both = {**small, "a/msg/C": large["a/srv/B"]}  # those of topics come last
    for types, told in ((large, {}), (small, small), (both, small)):
        answer = ProbeAnswer(
            slot=0,
            generation=1,
            incarnation="i",
            ready=frozenset({"/s"}),
            types=types,
            offered={"/s": "a/srv/B"},
        )
        decoded = probe_frames.decode_probe_answer(probe_frames.encode_probe_answer(answer))
        assert (decoded.types, decoded.ready) == (told, {"/s"})
        assert decoded.offered == {"/s": "a/srv/B"}


@pytest.mark.parametrize("count", [400, 2000])
def test_the_most_that_a_pool_file_may_name_fits_into_a_probes_answer(count: int) -> None:
    """As ready and as told of; views of replicas behind a gateway are what is left out."""
    each = NAMES_BYTES_LIMIT // count
    names = [f"/{number:0{each - 1}}" for number in range(count)]
    behind = (GatewayView(slot=0, generation=1, state=LinkState.UP, ready=frozenset(names)),) * 20
    told = dict.fromkeys(names[: count // 3], "std_srvs/srv/SetBool")
    answer = ProbeAnswer(
        slot=0, generation=1, incarnation="i", ready=frozenset(names), offered=told, behind=behind
    )
    decoded = probe_frames.decode_probe_answer(probe_frames.encode_probe_answer(answer))
    assert (decoded.ready, decoded.offered) == (frozenset(names), told)
    assert len(decoded.behind) < 20


def test_too_many_services_for_a_frame_are_an_error_at_the_sender() -> None:
    """A frame that nobody could read is not sent."""
    answer = ProbeAnswer(
        slot=0, generation=1, incarnation="i", ready=frozenset(f"/{n:0100}" for n in range(3000))
    )
    with pytest.raises(ValueError, match="probe's answer"):
        probe_frames.encode_probe_answer(answer)


def test_a_probe_answer_nested_without_end_is_refused() -> None:
    """The parser's own recursion limit is a FrameError like any other."""
    with pytest.raises(FrameError):
        probe_frames.decode_probe_answer(b"[" * 60_000)
