"""Responses that say the same, or do not: field by field, after deserialising."""

from __future__ import annotations

import math

import pytest

from fogft.errors import RosError
from fogft.ros.messages import Comparison
from fogft.ros.types import trouble

pytestmark = pytest.mark.ros

PLAN = "nav_msgs/srv/GetPlan"
MAP = "nav_msgs/srv/GetMap"
X = "plan.poses.pose.position.x"


def plan(*xs: float, frame: str = "map", y: float = 0.0):
    from geometry_msgs.msg import PoseStamped
    from nav_msgs.srv import GetPlan

    response = GetPlan.Response()
    response.plan.header.frame_id = frame
    for x in xs:
        pose = PoseStamped()
        pose.pose.position.x, pose.pose.position.y = x, y
        response.plan.poses.append(pose)
    return response


@pytest.mark.parametrize(
    ("one", "other", "tolerances", "same"),
    [
        (plan(1.0, 2.0), plan(1.0, 2.0), {}, True),
        (plan(1.0), plan(1.0 + 1e-12), {}, False),
        (plan(1.0), plan(1.009), {X: 0.01}, True),
        (plan(1.0), plan(1.011), {X: 0.01}, False),
        (plan(1.0, y=0.0), plan(1.0, y=0.005), {X: 0.01}, False),
        (plan(1.0), plan(1.0, 1.0), {X: 9.0}, False),
        (plan(), plan(), {}, True),
        (plan(1.0, frame="map"), plan(1.0, frame="odom"), {}, False),
        (plan(math.nan), plan(math.nan), {}, True),
        (plan(math.nan), plan(1.0), {X: 9.0}, False),
        (plan(math.inf), plan(math.inf), {X: 0.1}, True),
    ],
)
def test_plans(one, other, tolerances, same):
    comparison = Comparison(PLAN, tolerances)
    read = (b"one", one), (b"other", other)  # bytes that differ
    assert comparison.agree(*read) == comparison.agree(*reversed(read)) == same


def test_lists_of_numbers():
    from nav_msgs.srv import GetMap

    one, other = GetMap.Response(), GetMap.Response()
    one.map.data = other.map.data = [1, 2, 3]
    comparison = Comparison(MAP, {"map.info.resolution": 0.1})
    read = (b"one", one), (b"other", other)
    assert comparison.agree(*read)
    one.map.info.resolution, other.map.info.resolution = 0.5, 0.55
    assert comparison.agree(*read)
    other.map.data = [1, 2, 4]
    assert not comparison.agree(*read)


def test_the_same_bytes_agree_without_a_look_at_what_they_mean():
    """Nearly all answers are: the thread that compares them receives for all services."""
    payload = b"the same"
    assert Comparison(PLAN, {}).agree((payload, None), (payload, None))


def test_padding_does_not_count():
    """CDR leaves gaps before wide fields; whatever lies in them, the message is the same."""
    from nav_msgs.srv import GetPlan
    from rclpy.serialization import serialize_message

    comparison = Comparison(PLAN, {})
    payload = bytes(serialize_message(plan(1.0, frame="a")))
    wanted = comparison.read(payload)
    same, seen = 0, 0
    for at in range(4, len(payload)):
        changed = payload[:at] + bytes([payload[at] ^ 0xAA]) + payload[at + 1 :]
        try:
            read = comparison.read(changed)
        except RosError:
            continue
        seen += 1
        same += comparison.agree(read, wanted)
    assert isinstance(wanted[1], GetPlan.Response)
    assert 0 < same < seen, "some bytes are padding, and some are not"


def test_noise_is_no_response():
    with pytest.raises(RosError, match="not a serialised"):
        Comparison(PLAN, {}).read(b"noise")


@pytest.mark.parametrize(
    "path", ["plan", "plan.header.frame_id", "plan.poses.x", "no_such", "plan.header.stamp.sec"]
)
def test_only_floats_have_tolerances(path):
    found = trouble(Comparison, PLAN, {path: 0.1})
    assert found is not None
    assert f"`{path}`" in found.message
    assert found.hint


def test_paths_lead_through_lists():
    assert trouble(Comparison, PLAN, {X: 0.1}) is None
