"""The pool file's rules agree with ROS itself: names, types, boolean fields."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import SpecError
from fogft.model import ros_names
from fogft.pool.commands.preview import checks_here
from fogft.poolfile import file
from fogft.ros.messages import bool_field
from fogft.ros.types import trouble
from tests.needs import need

pytestmark = pytest.mark.ros
need("rclpy")

from rclpy import exceptions  # noqa: E402
from rclpy import validate_full_topic_name as validation  # noqa: E402

nearly_names = st.from_regex(r"/?[a-zA-Z0-9_/-]{0,12}", fullmatch=True)


def accepted_by_ros(name: str) -> bool:
    try:
        return validation.validate_full_topic_name(name, is_service=True)
    except exceptions.InvalidServiceNameException:
        return False


@given(name=nearly_names | st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=6))
def test_a_name_is_accepted_exactly_if_ros_accepts_it(name):
    """After it was made absolute, for relative names are resolved in the root namespace."""
    absolute = name if name.startswith("/") else "/" + name
    try:
        ours = ros_names.absolute_service_name(name)
    except ValueError:
        ours = None
    assert (ours is not None) == accepted_by_ros(absolute)


def test_the_longest_name_that_we_accept_is_accepted_by_ros():
    longest = "/" + "a" * (ros_names.MAX_SERVICE_NAME - 1)
    assert ros_names.absolute_service_name(longest) == longest
    assert accepted_by_ros(longest)
    with pytest.raises(ValueError, match="longer than"):
        ros_names.absolute_service_name(longest + "a")


def fault(service):
    source = f"run: x\nfogft:\n  services: [{{name: a, {service}}}]\n"
    with pytest.raises(SpecError) as caught:
        file.parse(source, "p.yaml", checks_here())
    return caught.value.message, caught.value.hint


def test_a_type_that_is_not_installed():
    assert fault("type: std_srvs/srv/SetBol") == (
        "p.yaml:3: fogft.services[0].type: package `std_srvs` has no service type `SetBol`",
        "is the sourced workspace's build up to date? Did you mean `std_srvs/srv/SetBool`?",
    )


def test_a_field_that_is_not_boolean():
    assert fault("type: std_srvs/srv/SetBool, ok_field: message") == (
        "p.yaml:3: fogft.services[0].ok_field: "
        "the response of `std_srvs/srv/SetBool` has no boolean field `message`",
        "its boolean fields: success",
    )


def test_a_boolean_field_and_its_type():
    assert trouble(bool_field, "std_srvs/srv/SetBool", "success") is None
