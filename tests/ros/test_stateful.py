"""A state through real services: the helper classes, the proxy's reading and writing of fields."""

from __future__ import annotations

import pytest

from fogft.errors import RosError
from fogft.model.state import FIELD, RESTORE_TYPE, SNAPSHOT_TYPE, StateService, StateSpec
from fogft.ros.state_bytes import StateBytes
from fogft.ros.stateful import AttributeState, StateServices
from fogft.ros.types import trouble

pytestmark = pytest.mark.ros

DEFAULT = StateSpec(
    StateService("/s/get_state", SNAPSHOT_TYPE, FIELD),
    StateService("/s/set_state", RESTORE_TYPE, FIELD),
)


def spec(out: tuple[str, str], into: tuple[str, str] = (RESTORE_TYPE, FIELD)) -> StateSpec:
    return StateSpec(StateService("/g", *out), StateService("/s", *into))


class Node:
    """What the helpers ask of a node."""

    def __init__(self) -> None:
        self.made = {}
        self.errors: list[str] = []

    def create_service(self, kind, name, callback):
        self.made[name] = (kind, callback)
        return name

    def get_logger(self):
        return self

    def error(self, text: str) -> None:
        self.errors.append(text)

    def call(self, name: str, request: bytes) -> bytes:
        """Call as the middleware would: bytes in, bytes out."""
        from rclpy.serialization import deserialize_message, serialize_message

        kind, callback = self.made[name]
        asked = deserialize_message(request, kind.Request)
        return bytes(serialize_message(callback(asked, kind.Response())))


class Owner:
    total = 5
    names = ["a", "ü"]


@pytest.mark.parametrize("state", [b"", b"\x00\xff\n" * 1000, bytes(range(256))])
def test_any_bytes_travel_through_the_default_types(state):
    node, taken = Node(), []
    helper = StateServices(node, "/s", lambda: state, taken.append)
    assert helper.services == ("/s/get_state", "/s/set_state")
    travel = StateBytes(DEFAULT)
    got = travel.read_snapshot(node.call("/s/get_state", travel.snapshot_request()))
    assert got == state
    travel.check_restored(node.call("/s/set_state", travel.restore_request(got)))
    assert taken == [state]


def test_attributes_are_taken_and_given():
    node, one, other = Node(), Owner(), Owner()
    AttributeState(node, "/one", one, "total", "names")
    AttributeState(node, "/other/", other, "total", "names")
    one.total, one.names = 17, ["b"]
    travel = StateBytes(DEFAULT)
    state = travel.read_snapshot(node.call("/one/get_state", travel.snapshot_request()))
    travel.check_restored(node.call("/other/set_state", travel.restore_request(state)))
    assert (other.total, other.names) == (17, ["b"])


def test_a_restore_that_raises_is_a_failure_with_its_reason_in_the_nodes_log():
    node = Node()
    AttributeState(node, "/s", Owner(), "total")
    travel = StateBytes(DEFAULT)
    answer = node.call("/s/set_state", travel.restore_request(b"no json"))
    with pytest.raises(RosError, match="success: false"):
        travel.check_restored(answer)
    assert "JSONDecodeError" in node.errors[0]


def test_text_fields_carry_text_and_a_refusal_its_message():
    from rclpy.serialization import serialize_message
    from std_srvs.srv import Trigger

    travel = StateBytes(
        spec(("std_srvs/srv/Trigger", "message"), ("nav_msgs/srv/LoadMap", "map_url"))
    )
    good = bytes(serialize_message(Trigger.Response(success=True, message="grün")))
    assert travel.read_snapshot(good) == "grün".encode()
    assert b"gr\xc3\xbcn" in travel.restore_request("grün".encode())
    bad = bytes(serialize_message(Trigger.Response(success=False, message="busy")))
    with pytest.raises(RosError, match="busy"):
        travel.read_snapshot(bad)
    with pytest.raises(RosError, match="does not fit"):
        travel.restore_request(b"\xff")
    with pytest.raises(RosError, match="are not a"):
        travel.read_snapshot(b"noise")


@pytest.mark.parametrize(
    ("out", "into", "what"),
    [
        (("std_srvs/srv/Trigger", "success"), (RESTORE_TYPE, FIELD), "`success`"),
        (("std_srvs/srv/Trigger", "no_such"), (RESTORE_TYPE, FIELD), "`no_such`"),
        ((SNAPSHOT_TYPE, "map.no_such.data"), (RESTORE_TYPE, FIELD), "`map.no_such`"),
        ((SNAPSHOT_TYPE, "map"), (RESTORE_TYPE, FIELD), "`map`"),
        (("std_srvs/srv/Trigger", "message"), (RESTORE_TYPE, FIELD), "is text, the other bytes"),
        (("no_such_pkg/srv/A", "a"), (RESTORE_TYPE, FIELD), "no_such_pkg"),
    ],
)
def test_what_cannot_carry_a_state_is_told_with_what_to_do(out, into, what):
    found = trouble(StateBytes, spec(out, into))
    assert found is not None
    assert what in found.message
    assert found.hint


def test_the_defaults_are_usable():
    assert trouble(StateBytes, DEFAULT) is None
