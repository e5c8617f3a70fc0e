"""What is a well-formed message, and what is not."""

from __future__ import annotations

import struct
import tracemalloc
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.cdr import Shape
from tests.needs import needs

LITTLE, BIG = b"\x00\x01\x00\x00", b"\x00\x00\x00\x00"
SET_BOOL = Shape("response", {"response": (("success", "boolean"), ("message", "string"))})
HEARD = LITTLE + b"\x01\xaa\xbb\xcc" + struct.pack("<I", 3) + b"ok\0"


@pytest.mark.parametrize("padding", [b"", b"\0", b"\xff\xff\xff"])
def test_a_whole_message_is_well_formed(padding: bytes) -> None:
    """Whatever fills the gaps between fields and the message's end."""
    assert SET_BOOL.fault(HEARD + padding) == ""
    assert SET_BOOL.fault(BIG + b"\x00\0\0\0" + struct.pack(">I", 1) + b"\0" + padding) == ""


@pytest.mark.parametrize(
    "payload",
    [b"", b"\x00\x01", LITTLE, HEARD[:-1], HEARD[:8], HEARD + bytes(28), b"\x00\x07" + HEARD[2:]],
)
def test_what_is_cut_or_too_long_is_not(payload: bytes) -> None:
    assert SET_BOOL.fault(payload) != ""


@pytest.mark.parametrize("size", [0, 4, 11, 65_536])
@pytest.mark.parametrize("filled_with", [0x00, 0x01, 0x2A, 0xFF])
def test_junk_is_not(size: int, filled_with: int) -> None:
    assert SET_BOOL.fault(bytes([filled_with]) * size) != ""


def test_a_boolean_is_0_or_1() -> None:
    assert SET_BOOL.fault(HEARD[:4] + b"\x02" + HEARD[5:]) == "a boolean is 2"
    flags = Shape("m", {"m": (("flags", "sequence<boolean>"),)})
    assert flags.fault(LITTLE + struct.pack("<I", 3) + b"\0\1\1") == ""
    assert flags.fault(LITTLE + struct.pack("<I", 3) + b"\0\1\2") == "a boolean is 2"


def test_a_boolean_deep_in_a_long_sequence_is_seen() -> None:
    """Of whole runs of equal structs, each boolean is looked at."""
    shape = Shape("m", {"m": (("s", "sequence<S>"),), "S": (("x", "float"), ("on", "boolean"))})
    elements = bytearray(b"\0\0\0\0\1\xaa\xbb\xcc" * 1000)
    head = LITTLE + struct.pack("<I", 1000)
    assert shape.fault(head + bytes(elements)) == ""
    elements[8 * 777 + 4] = 3
    assert shape.fault(head + bytes(elements)) == "a boolean is 3"


@pytest.mark.parametrize("wrong", [4, 5, 6, 7, 8, 9, 16, 21, 27])
def test_a_boolean_in_an_array_in_a_sequence_is_seen(wrong: int) -> None:
    shape = Shape("m", {"m": (("s", "sequence<S>"),), "S": (("on", "boolean[3]"),)})
    payload = bytearray(LITTLE + struct.pack("<I", 10) + bytes([1] * 30))
    assert shape.fault(bytes(payload)) == ""
    payload[4 + wrong] = 7
    assert shape.fault(bytes(payload)) != ""


def test_a_sequence_beyond_its_bound_is_refused_and_a_text_is_not() -> None:
    """A reader may have no room for more elements. Three characters may be six bytes."""
    bounded = Shape("m", {"m": (("name", "string<3>"), ("values", "sequence<uint8, 2>"))})
    name, values = struct.pack("<I", 4) + b"abc\0", struct.pack("<I", 2) + b"\1\2"
    assert bounded.fault(LITTLE + name + values) == ""
    assert bounded.fault(LITTLE + struct.pack("<I", 7) + "äöü\0\0".encode() + values) == ""
    assert bounded.fault(LITTLE + name + struct.pack("<I", 3) + b"\1\2\3") != ""


def test_a_huge_count_costs_no_time() -> None:
    """A count of four billion in a few bytes is seen at once."""
    points = Shape("m", {"m": (("p", "sequence<P>"),), "P": (("x", "string"),)})
    assert points.fault(LITTLE + b"\xff\xff\xff\xff" + bytes(40)) != ""


def test_a_long_sequence_of_booleans_takes_no_memory_of_its_own() -> None:
    shape = Shape("message", {"message": (("flags", "sequence<boolean>"),)})
    count = 1 << 20
    payload = LITTLE + struct.pack("<I", count) + bytes(count)
    tracemalloc.start()
    try:
        assert shape.fault(payload) == ""
        assert tracemalloc.get_traced_memory()[1] < 3 * count
    finally:
        tracemalloc.stop()


def test_a_message_without_fields_has_one_byte() -> None:
    empty = Shape("m", {"m": ()})
    assert empty.fault(LITTLE + b"\0") == ""
    assert empty.fault(LITTLE) != ""


@pytest.mark.parametrize("kind", ["wstring", "sequence<wstring<3>>", "unknown_msgs/Thing", "m"])
def test_of_a_type_that_cannot_be_followed_the_header_is_checked(kind: str) -> None:
    """Middlewares differ in how they write wide characters; nothing is refused by a guess."""
    shape = Shape("m", {"m": (("field", kind),)})
    assert shape.fault(LITTLE + bytes(500)) == ""
    assert shape.fault(b"\x01") != ""


@given(
    counts=st.lists(st.integers(0, 40), min_size=1, max_size=3),
    kind=st.sampled_from(["uint8", "int16", "float", "double", "P", "Q"]),
    cut=st.integers(1, 9),
)
def test_sequences_of_any_alignment_are_followed(counts: list[int], kind: str, cut: int) -> None:
    """What is written by the rules of CDR is well-formed, and nothing shorter is."""
    fields = {
        "m": tuple((f"s{n}", f"sequence<{kind}>") for n in range(len(counts))),
        "P": (("x", "float"), ("y", "uint8")),
        "Q": (("head", "uint16"), ("p", "P[2]"), ("at", "double")),
    }
    body = bytearray()

    def number(size: int) -> None:
        body.extend(bytes(-len(body) % size))
        body.extend(bytes(size))

    def value(of: str) -> None:
        sizes = {"uint8": 1, "int16": 2, "float": 4, "double": 8}
        steps: dict[str, list[str]] = {
            "P": ["float", "uint8"],
            "Q": ["int16", "P", "P", "double"],
        }
        if of in sizes:
            number(sizes[of])
        for step in steps.get(of, []):
            value(step)

    for count in counts:
        body.extend(bytes(-len(body) % 4))
        body.extend(struct.pack("<I", count))
        for _ in range(count):
            value(kind)
    shape = Shape("m", fields)
    assert shape.fault(LITTLE + bytes(body)) == ""
    assert shape.fault(LITTLE + bytes(body[:-1])) != ""
    assert shape.fault(LITTLE + bytes(body) * 2 + bytes(7 + cut)) != ""


@given(payload=st.binary(max_size=64))
def test_any_bytes_are_judged_without_an_error(payload: bytes) -> None:
    assert isinstance(SET_BOOL.fault(payload), str)


TYPES = [
    "std_srvs/srv/SetBool",
    "std_srvs/srv/Empty",
    "nav_msgs/srv/GetPlan",
    "nav_msgs/srv/SetMap",
    "sensor_msgs/srv/SetCameraInfo",
    pytest.param("test_msgs/srv/Arrays", marks=needs("test_msgs")),
    pytest.param("test_msgs/srv/BasicTypes", marks=needs("test_msgs")),
    "rcl_interfaces/srv/SetParameters",
    "rcl_interfaces/srv/DescribeParameters",
]


def filled(message: Any, depth: int = 0) -> Any:
    """Give every text and sequence of a message some content."""
    from importlib import import_module

    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if kind == "string":
            setattr(message, name, "text" * depth)
        elif kind == "sequence<string>":
            setattr(message, name, ["a", "", "bcd"])
        elif kind.startswith("sequence<") and "/" in kind and "," not in kind and depth < 4:
            package, _, short = kind[len("sequence<") : -1].partition("/")
            made = getattr(import_module(f"{package}.msg"), short)
            setattr(message, name, [filled(made(), depth + 1) for _ in range(3)])
        elif hasattr(value, "get_fields_and_field_types"):
            filled(value, depth + 1)
    return message


@pytest.mark.ros
@pytest.mark.parametrize("name", TYPES)
def test_what_ros_writes_is_well_formed_and_what_is_cut_is_not(name: str) -> None:
    """Of real types, with the middleware that is installed."""
    from rclpy.serialization import serialize_message

    from fogft.model.type_definition import REQUEST, RESPONSE
    from fogft.ros.types import definition, load_service_type

    service_type, known = load_service_type(name), definition(name)
    for part, message_type in (
        (REQUEST, service_type.Request),
        (RESPONSE, service_type.Response),
    ):
        shape = Shape(part, known.fields)
        for message in (message_type(), filled(message_type())):
            payload = bytes(serialize_message(message))
            assert shape.fault(payload) == ""
            assert shape.fault(payload * 2 + bytes(16)) != ""
            assert shape.fault(payload[: len(payload) // 2]) != ""
