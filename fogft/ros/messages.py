"""Convert Python messages to and from bytes, which are validated first.

CycloneDDS aborts the process on a message of fewer than four bytes, and accepts some that Fast DDS
rejects. So bytes are first validated against their type (`fogft.model.cdr`).

Owns: rclpy's two functions, default responses, boolean fields, comparing responses, merging the
replicas' status lists of an action. Not here: C messages (`serialised`), votes
(`fogft.requests.votes`), which status counts (`fogft.topics.goals`).
"""

import math
import re
from collections.abc import Callable, Mapping
from typing import Any

from fogft.errors import RosError, Unreadable
from fogft.model.cdr import NUMBER_BYTES
from fogft.model.type_definition import nested
from fogft.ros.types import load_service_type, nested_type, shape
from fogft.topics import goals

_XCDR1_HEADERS = (b"\x00\x00", b"\x00\x01")  # big and little endian
_FLOAT = re.compile(r"(sequence<)?(float|double)\b.*")  # one, or a list of them


def to_bytes(message: Any) -> bytes:
    """Serialise a message."""
    from rclpy.serialization import serialize_message

    return bytes(serialize_message(message))


def from_bytes(payload: bytes, message_type: Any) -> Any:
    """Deserialise a message. Raises Unreadable."""
    from rclpy.serialization import deserialize_message

    fault = shape(message_type).fault(payload)
    if not fault:
        try:
            return deserialize_message(payload, message_type)
        except Exception as error:  # rclpy's own error types are private and vary by release
            fault = str(error)
    raise Unreadable(f"{len(payload)} bytes are not a serialised {message_type.__name__}: {fault}")


def default_response(name: str) -> bytes:
    """Return the serialised default response of a service type. Raises RosError."""
    return to_bytes(load_service_type(name).Response())


def bool_field(name: str, field: str) -> Callable[[bytes], bool]:
    """Return a function that reads a boolean field of a serialised response.

    The function raises Unreadable for bytes that are not such a response. If only numbers
    precede the field, it reads one byte; else it deserialises the response.

    Raises RosError: The type cannot be loaded, or its response has no such boolean field.
    """
    response_type = load_service_type(name).Response
    fields: dict[str, str] = response_type.get_fields_and_field_types()
    if fields.get(field) != "boolean":
        booleans = [key for key, kind in fields.items() if kind == "boolean"]
        raise RosError(
            f"the response of `{name}` has no boolean field `{field}`",
            f"its boolean fields: {', '.join(booleans) or 'none'}",
        )

    def read_all(payload: bytes) -> bool:
        return bool(getattr(from_bytes(payload, response_type), field))

    offset = fixed_offset(fields, field)
    if offset is None:
        return read_all

    def read_byte(payload: bytes) -> bool:
        if payload[:2] in _XCDR1_HEADERS and offset < len(payload):
            return payload[offset] != 0
        return read_all(payload)

    return read_byte


def fixed_offset(fields: dict[str, str], field: str) -> int | None:
    """Return a field's byte offset in every serialised message; None if it varies."""
    offset = 0
    for name, kind in fields.items():
        size = NUMBER_BYTES.get(kind)
        if size is None:
            return None
        offset += -offset % size
        if name == field:
            return 4 + offset  # after the header, from which alignment is counted
        offset += size
    return None


def merged_status(said: Mapping[int, bytes]) -> bytes | None:
    """Merge the replicas' last `action_msgs/msg/GoalStatusArray` messages (CDR) into one.

    None if a list cannot be read: it does not come from an action server.
    """
    from action_msgs.msg import GoalStatusArray

    entries: dict[bytes, Any] = {}
    statuses: dict[int, dict[bytes, int]] = {}
    try:
        for replica, message in said.items():
            listed = from_bytes(message, GoalStatusArray).status_list
            statuses[replica] = {bytes(one.goal_info.goal_id.uuid): one.status for one in listed}
            for one in listed:
                entries.setdefault(bytes(one.goal_info.goal_id.uuid), one)
    except Unreadable:
        return None
    found = GoalStatusArray()
    for goal, status in goals.merged(statuses).items():
        entries[goal].status = status
        found.status_list.append(entries[goal])
    return to_bytes(found)


class Comparison:
    """Compares responses of a service type field by field, as padding between fields is arbitrary.

    Args:
        tolerances: Path of a float field -> the maximum difference of two values. A path passes
            through lists to their elements. All other fields must be equal.

    Raises RosError: The type cannot be loaded, or has no such float field.
    """

    def __init__(self, type_name: str, tolerances: Mapping[str, float]) -> None:
        self._response = load_service_type(type_name).Response
        self._tolerances = dict(tolerances)
        for path in tolerances:
            _check_float(self._response, type_name, path)

    def read(self, payload: bytes) -> tuple[bytes, Any]:
        """Return the bytes and the message that they hold. Raises Unreadable."""
        return payload, from_bytes(payload, self._response)

    def agree(self, one: tuple[bytes, Any], other: tuple[bytes, Any]) -> bool:
        """Whether two messages returned by `read` are equal within the tolerances.

        NaN agrees with NaN.
        """
        return one[0] == other[0] or self._same(one[1], other[1], "")

    def _same(self, one: Any, other: Any, path: str) -> bool:
        if isinstance(one, float):
            close = abs(one - other) <= self._tolerances.get(path, 0.0)
            return one == other or close or (math.isnan(one) and math.isnan(other))
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
        if hasattr(one, "tobytes"):  # an array of numbers: usually identical
            if one.tobytes() == other.tobytes():
                return True
            kind = getattr(one, "typecode", None) or one.dtype.kind
            if kind not in "fd":
                return False
        return all(self._same(_plain(a), _plain(b), path) for a, b in zip(one, other, strict=True))


def _plain(value: Any) -> Any:
    return value.item() if hasattr(value, "item") else value


def _check_float(message_type: Any, type_name: str, path: str) -> None:
    *parents, last = path.split(".")
    for parent in parents:
        kind = nested(message_type.get_fields_and_field_types().get(parent, ""))
        message_type = nested_type(kind) if kind else None
        if message_type is None:
            break
    fields = message_type.get_fields_and_field_types() if message_type else {}
    if not _FLOAT.fullmatch(fields.get(last, "")):
        raise RosError(
            f"the response of `{type_name}` has no float field `{path}`",
            "write the path from the response, such as `plan.poses.pose.position.x`",
        )
