"""Whether two serialised responses say the same: compared field by field, floats with tolerance.

Bytes cannot be compared: the padding of CDR is whatever lay in memory. So both are made
Python messages, which plain services never need.

Owns: reading and comparing responses of one type. Not here: votes (`fogft.requests.votes`).
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping
from typing import Any

from fogft.errors import RosError
from fogft.ros.types import load_service_type

_FLOATS = ("float", "double")


class Comparison:
    """Compares responses of a service type.

    Args:
        type_name: ``package/srv/Type``.
        tolerances: Path of a float field -> how far two values may be apart. A path leads
            through lists as through their elements. All else must be equal.

    Raises:
        RosError: The type cannot be loaded, or has no such float field.
    """

    def __init__(self, type_name: str, tolerances: Mapping[str, float]) -> None:
        from rclpy.serialization import deserialize_message

        self._read = deserialize_message
        self._response = load_service_type(type_name).Response
        self._name = type_name
        self._tolerances = dict(tolerances)
        for path in tolerances:
            _check_float(self._response, type_name, path)

    def read(self, payload: bytes) -> Any:
        """Return the message. Raises RosError for bytes that are no such response."""
        try:
            return self._read(payload, self._response)
        except Exception as error:  # rclpy's own error types are private and vary by release
            raise RosError(f"{len(payload)} bytes are not a response of `{self._name}`") from error

    def agree(self, one: Any, other: Any) -> bool:
        """Whether two messages are the same, within the tolerances. NaN agrees with NaN."""
        return self._same(one, other, "")

    def _same(self, one: Any, other: Any, path: str) -> bool:
        if isinstance(one, float):
            return _close(one, other, self._tolerances.get(path, 0.0))
        if hasattr(one, "get_fields_and_field_types"):
            prefix = f"{path}." if path else ""
            return all(
                self._same(getattr(one, name), getattr(other, name), prefix + name)
                for name in one.get_fields_and_field_types()
            )
        if isinstance(one, (str, bytes, bool, int)):
            return bool(one == other)
        return len(one) == len(other) and self._same_elements(one, other, path)

    def _same_elements(self, one: Any, other: Any, path: str) -> bool:
        if hasattr(one, "tobytes"):  # numbers, side by side: usually there is no difference at all
            if one.tobytes() == other.tobytes():
                return True
            kind = getattr(one, "typecode", None) or one.dtype.kind
            if kind not in "fd":
                return False
        return all(self._same(_plain(a), _plain(b), path) for a, b in zip(one, other, strict=True))


def _plain(value: Any) -> Any:
    return value.item() if hasattr(value, "item") else value


def _close(one: float, other: float, tolerance: float) -> bool:
    return one == other or abs(one - other) <= tolerance or (math.isnan(one) and math.isnan(other))


def _check_float(message_type: Any, type_name: str, path: str) -> None:
    """Raise RosError where a path does not lead to a float."""
    *parents, last = path.split(".")
    for parent in parents:
        kind = _element(message_type.get_fields_and_field_types().get(parent, ""))
        if "/" not in kind:
            raise _no_float(type_name, path)
        package, _, name = kind.partition("/")
        message_type = getattr(importlib.import_module(f"{package}.msg"), name)
    if _element(message_type.get_fields_and_field_types().get(last, "")) not in _FLOATS:
        raise _no_float(type_name, path)


def _element(kind: str) -> str:
    """Return what a list's elements are; a single value is its own element."""
    if kind.startswith("sequence<"):
        return kind.removeprefix("sequence<").rstrip(">").split(",")[0]
    return kind.split("[", maxsplit=1)[0]


def _no_float(type_name: str, path: str) -> RosError:
    return RosError(
        f"the response of `{type_name}` has no float field `{path}`",
        "write the path from the response, such as `plan.poses.pose.position.x`",
    )


def check_tolerances(type_name: str, tolerances: Mapping[str, float]) -> str | None:
    """Return why responses cannot be compared so, with what to do; None if they can."""
    try:
        Comparison(type_name, tolerances)
    except RosError as error:
        return f"{error.message}; {error.hint}" if error.hint else error.message
    except ImportError as error:
        return f"ROS 2 is not usable here: {error}; source a ROS 2 installation"
    return None
