"""The way through C messages equals rclpy's own, and refuses what it refuses."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fogft.errors import RosError
from fogft.ros import memory_tuning, messages, serialised
from fogft.ros.messages import Comparison
from fogft.ros.node import SerialisedNode
from fogft.ros.types import load_service_type
from tests.nightly import by_day

from .conftest import SET_BOOL

pytestmark = pytest.mark.ros

TYPES = [
    SET_BOOL,
    "nav_msgs/srv/GetPlan",
    "nav_msgs/srv/SetMap",
    "sensor_msgs/srv/SetCameraInfo",
    "test_msgs/srv/Arrays",
    "test_msgs/srv/BasicTypes",
    "test_msgs/srv/Empty",
    "rcl_interfaces/srv/SetParameters",
]


def through_c(message: Any) -> Any:
    """Send a message through its bytes, the C message and its bytes again."""
    from rclpy.serialization import deserialize_message, serialize_message

    held = serialised.CMessage(type(message))
    try:
        held.read(bytes(serialize_message(message)))
        return deserialize_message(held.write(), type(message))
    finally:
        held.close()
        held.close()


@pytest.mark.parametrize("name", TYPES)
def test_defaults_of_every_type_come_back(name: str) -> None:
    service_type = load_service_type(name)
    for message_type in (service_type.Request, service_type.Response):
        assert through_c(message_type()) == message_type()


def test_a_node_is_not_made_where_messages_come_back_changed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of a ROS 2 whose C library is another than we take it for nothing is used."""
    from rcl_interfaces.msg import Parameter

    serialised.self_test()
    monkeypatch.setattr(serialised.CMessage, "write", lambda *_: messages.to_bytes(Parameter()))
    serialised.self_test.cache_clear()
    with pytest.raises(RosError, match=r"cannot be created.*came back changed"):
        SerialisedNode("fogft_never")
    with pytest.raises(RosError, match="came back changed"):
        serialised.self_test()


numbers = st.integers(-128, 127)


@settings(max_examples=by_day(20, at_night=400), deadline=None)
@given(cells=st.lists(numbers, max_size=50), frame=st.text(alphabet="abcé", max_size=12))
def test_a_map_survives_as_it_is(cells: list[int], frame: str) -> None:
    """Both ways agree on sequences, nested messages and text."""
    request = load_service_type("nav_msgs/srv/SetMap").Request()
    request.map.data = cells
    request.map.header.frame_id = frame
    request.initial_pose.pose.covariance[7] = 0.5
    assert through_c(request) == request
    kept = messages.from_bytes(messages.to_bytes(request), type(request))
    assert through_c(kept) == kept


@settings(max_examples=by_day(20, at_night=400), deadline=None)
@given(names=st.lists(st.text(alphabet="ab_é", max_size=8), max_size=5), value=st.floats(-1e9, 1e9))
def test_nested_sequences_survive_as_they_are(names: list[str], value: float) -> None:
    """Sequences of messages with text and sequences inside come through whole."""
    from rcl_interfaces.msg import Parameter

    request = load_service_type("rcl_interfaces/srv/SetParameters").Request()
    for name in names:
        parameter = Parameter(name=name)
        parameter.value.double_array_value = [value] * len(names)
        parameter.value.string_array_value = names
        request.parameters.append(parameter)
    assert through_c(request) == request


def test_a_message_is_used_again_and_keeps_nothing_of_the_last() -> None:
    """Large, small, malformed, small: each reading stands for itself."""
    from rclpy.serialization import deserialize_message, serialize_message

    request_type = load_service_type("nav_msgs/srv/SetMap").Request
    large, small = request_type(), request_type()
    large.map.data = [5] * 1_000_000
    small.map.data = [7]
    message = serialised.CMessage(request_type)
    for given_message in (large, small, None, small, large):
        if given_message is None:
            with pytest.raises(RosError, match="not a serialised SetMap_Request"):
                message.read(bytes(serialize_message(large))[:-1000])
            continue
        message.read(bytes(serialize_message(given_message)))
        written = message.write()
        assert deserialize_message(written, request_type) == given_message
    message.close()


LEFT_OVER = b"\0\1\0\0\1\0\0\0\1\0\0\0\0" + bytes(99)  # Fast DDS takes it


@pytest.mark.parametrize(
    "payload", [b"", b"\0", b"\0\1\0\0", b"\0\1\0\0\xff\xff\xff\xff", LEFT_OVER]
)
def test_both_ways_refuse_the_same(payload: bytes) -> None:
    """We judge the bytes, so that what is refused does not depend on the middleware."""
    response_type = load_service_type(SET_BOOL).Response
    message = serialised.CMessage(response_type)
    with pytest.raises(RosError, match="not a serialised SetBool_Response"):
        message.read(payload)
    message.close()
    with pytest.raises(RosError, match="not a serialised SetBool_Response"):
        messages.from_bytes(payload, response_type)
    with pytest.raises(RosError, match="not a serialised SetBool_Response"):
        Comparison(SET_BOOL, {}).read(payload)


@pytest.mark.parametrize("seed", range(3))
def test_noise_never_crashes_the_reader(seed: int) -> None:
    """Forged lengths, cut messages and random bytes are read or refused, in a process apart."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.ros.nodes.fuzz_reader", str(seed), "400", *TYPES],
        cwd=Path(__file__).parents[2],
        timeout=100,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    read, refused = map(int, done.stdout.split())
    assert read + refused == 400 * 2 * len(TYPES)
    assert min(read, refused) > 400


def test_malloc_is_tuned() -> None:
    """After tuning, a large block comes from the heap, not from a mapping of its own."""
    code = (
        "import ctypes, re\n"
        "from fogft.ros import memory_tuning\n"
        "libc = ctypes.CDLL(None); libc.malloc.restype = ctypes.c_void_p\n"
        "libc.mallinfo2.restype = type('M', (ctypes.Structure,),"
        " {'_fields_': [(n, ctypes.c_size_t) for n in 'abcdefghij']})\n"
        "def mapped(): libc.malloc(3_000_000); return libc.mallinfo2().d\n"
        "before = mapped(); assert memory_tuning.tune(); start = libc.mallinfo2().d\n"
        "print(before > 0, mapped() - start)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=100
    )
    assert done.stdout.split() == ["True", "0"]
    assert callable(memory_tuning.tune)
