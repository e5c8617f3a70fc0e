"""Service types by name, and what is read from their responses."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fogft.errors import RosError
from fogft.model.type_definition import difference
from fogft.proxy.replica.responder import CANCEL_TYPE, EMPTY_REQUEST
from fogft.ros import messages, types
from fogft.ros.types import definition

from .conftest import SET_BOOL

pytestmark = pytest.mark.ros


@pytest.mark.parametrize(
    ("name", "message", "hint"),
    [
        ("SetBool", "not the name of a service type", "`std_srvs/srv/SetBool`"),
        ("std_srvs/SetBool", "not the name", "Did you mean `std_srvs/srv/SetBool`?"),
        ("std_msgs/msg/String", "not the name", "write `package/srv/Type`"),
        ("../srv/Evil", "not the name", "write `package/srv/Type`"),
        ("", "not the name", "write `package/srv/Type`"),
        ("my_msgs/srv/Detect", "no package `my_msgs`", "source its workspace"),
        ("std_srv/srv/SetBool", "no package `std_srv`", "Did you mean `std_srvs/srv/SetBool`?"),
        ("std_srvs/srv/SetBoll", "no service type `SetBoll`", "`std_srvs/srv/SetBool`?"),
        ("nav_msgs/srv/SetBool", "no service type `SetBool`", "`std_srvs/srv/SetBool`?"),
        ("json/srv/Dumps", "no package `json` with services", "install"),
        (
            "my_msgs/action/Search_SendGoal",
            "no package `my_msgs` with actions here, so `my_msgs/action/Search` cannot",
            "install",
        ),
        ("test_msgs/action/Fib_GetResult", "no action type `Fib`", "up to date"),
    ],
)
def test_a_wrong_type_says_what_is_wrong_and_what_to_do(name: str, message: str, hint: str) -> None:
    with pytest.raises(RosError, match=message) as caught:
        types.load_service_type(name)
    assert hint in caught.value.hint
    found = types.trouble(lambda: types.load_service_type(name))
    assert found is not None
    assert (found.message, found.hint) == (caught.value.message, caught.value.hint)


def test_a_good_type_has_nothing_against_it() -> None:
    assert types.trouble(types.load_type, SET_BOOL) is None
    assert types.load_service_type(SET_BOOL).Request().data is False


def test_a_package_that_cannot_be_imported_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever generated code raises comes out as an error with a hint."""
    package = tmp_path / "broken_msgs" / "srv"
    package.mkdir(parents=True)
    (tmp_path / "broken_msgs" / "__init__.py").touch()
    (package / "__init__.py").write_text("import not_here_at_all\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(RosError, match="not_here_at_all") as caught:
        types.load_service_type("broken_msgs/srv/Any")
    assert "source" in caught.value.hint


def test_a_type_without_its_c_library_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A package copied without its libraries loads in Python, and is still refused."""
    package = tmp_path / "half_msgs" / "srv"
    package.mkdir(parents=True)
    (tmp_path / "half_msgs" / "__init__.py").touch()
    (package / "__init__.py").write_text(
        "class Meta(type):\n"
        "    _TYPE_SUPPORT = None\n"
        "    @classmethod\n"
        "    def __import_type_support__(cls): pass\n"
        "class Half(metaclass=Meta):\n"
        "    Request = Response = None\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(RosError, match="C library of `half_msgs/srv/Half`"):
        types.load_service_type("half_msgs/srv/Half")


def test_checking_a_type_does_not_start_ros() -> None:
    """The pool file's reader checks types: that must stay cheap."""
    code = (
        "import sys; from fogft.ros.types import load_type, trouble\n"
        f"assert trouble(load_type, '{SET_BOOL}') is None\n"
        "assert 'rclpy' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=100)


def test_installed_types_are_listed() -> None:
    assert SET_BOOL in types.installed_service_types()
    assert all("/srv/" in name for name in types.installed_service_types())


def test_the_default_response_reads_back_as_the_default() -> None:
    from nav_msgs.srv import GetPlan
    from rclpy.serialization import deserialize_message

    payload = messages.default_response("nav_msgs/srv/GetPlan")
    assert deserialize_message(payload, GetPlan.Response) == GetPlan.Response()


@settings(max_examples=30, deadline=None)
@given(success=st.booleans(), text=st.text(alphabet="abc", max_size=20))
def test_a_boolean_at_a_fixed_place(success: bool, text: str) -> None:
    """The field is read as rclpy reads it, whatever follows it."""
    from rclpy.serialization import serialize_message
    from std_srvs.srv import SetBool

    payload = bytes(serialize_message(SetBool.Response(success=success, message=text)))
    assert messages.bool_field(SET_BOOL, "success")(payload) is success


@settings(max_examples=30, deadline=None)
@given(success=st.booleans(), text=st.text(alphabet="abc", max_size=20))
def test_a_boolean_behind_numbers_and_text(success: bool, text: str) -> None:
    """The same where numbers, or fields of varying length, stand before it."""
    from rclpy.serialization import serialize_message
    from test_msgs.srv import Arrays, BasicTypes

    basic = BasicTypes.Response(bool_value=success, uint64_value=7, string_value=text)
    read = messages.bool_field("test_msgs/srv/BasicTypes", "bool_value")
    assert read(bytes(serialize_message(basic))) is success
    with pytest.raises(RosError, match="no boolean field"):
        messages.bool_field("test_msgs/srv/Arrays", "bool_values")
    assert Arrays.Response().bool_values == [False] * 3


@pytest.mark.parametrize("field", ["message", "nothing", "success.deep", ""])
def test_a_field_that_is_no_boolean_is_an_error(field: str) -> None:
    with pytest.raises(RosError, match="no boolean field") as caught:
        messages.bool_field(SET_BOOL, field)
    assert caught.value.hint == "its boolean fields: success"


def test_offsets_follow_cdr_alignment() -> None:
    """Each number is aligned to its own size, counted from after the header."""
    fields = {"a": "uint8", "b": "double", "c": "boolean", "d": "uint16", "e": "boolean"}
    assert messages.fixed_offset(fields, "c") == 4 + 16
    assert messages.fixed_offset(fields, "e") == 4 + 20
    assert messages.fixed_offset({"t": "string", "b": "boolean"}, "b") is None
    assert messages.fixed_offset({"t": "uint8[3]", "b": "boolean"}, "b") is None


@pytest.mark.parametrize("payload", [b"", b"\x00\x01\x00\x00", b"\xff\xff\x00\x00\x01"])
def test_reading_a_field_of_noise_is_an_error(payload: bytes) -> None:
    with pytest.raises(RosError, match="not a serialised SetBool_Response"):
        messages.bool_field(SET_BOOL, "success")(payload)


def test_the_request_of_a_cancel_service_is_what_ros_would_serialise():
    from rclpy.serialization import serialize_message

    expected = serialize_message(types.load_service_type(CANCEL_TYPE).Request())
    assert bytes(expected)[:4] == EMPTY_REQUEST[:4]
    assert 4 < len(expected) <= len(EMPTY_REQUEST)  # not every middleware pads the end


def test_a_definition_has_the_hash_and_the_fields_of_the_loaded_code() -> None:
    found = definition("nav_msgs/srv/GetPlan")
    assert found.trouble == ""
    assert found.fields["request"][0] == ("start", "geometry_msgs/PoseStamped")
    assert found.fields["geometry_msgs/Quaternion"][-1] == ("w", "double")
    assert re.fullmatch(r"RIHS01_[0-9a-f]{64}\+RIHS01_[0-9a-f]{64}", found.hash)


def test_the_definition_of_a_topic_has_the_fields_of_its_message() -> None:
    stamp = ("sec", "int32"), ("nanosec", "uint32")
    clock = {"message": (("clock", "builtin_interfaces/Time"),), "builtin_interfaces/Time": stamp}
    assert definition("rosgraph_msgs/msg/Clock").fields == clock
    assert "p" in definition("p/msg/None").trouble


def test_every_installed_type_can_be_described_and_is_the_same_as_itself() -> None:
    names = types.installed_service_types()
    assert len(names) > 20
    for name in names:
        found = definition(name)
        assert found.trouble == "", name
        assert difference(name, found, replace(found, hash="")) == ""


def test_two_types_of_two_packages_are_told_apart_by_a_field() -> None:
    found = difference("a/srv/B", definition(SET_BOOL), definition("std_srvs/srv/Trigger"))
    assert "field `request.data` (`boolean`) is missing on the replica" in found


def test_a_type_that_is_not_here_is_trouble_and_no_exception() -> None:
    assert "no package `my_msgs`" in definition("my_msgs/srv/Detect").trouble
