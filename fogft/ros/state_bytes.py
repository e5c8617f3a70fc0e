"""A service's state as bytes, independent of the service types that carry it.

The state is in one text or byte field of a response (snapshot) and of a request (restore).
If the response has a boolean `success`, false is a failure. These calls are rare, so they may
build Python messages.

Owns: reading and writing that field. Not here: when (`fogft.proxy.replica.ordered_responder`).
"""

import array
import re
from functools import reduce
from typing import Any

from fogft.errors import RosError
from fogft.model.state import StateService, StateSpec
from fogft.ros.messages import from_bytes, to_bytes
from fogft.ros.types import load_service_type

_SEQUENCE = re.compile(r"sequence<(octet|uint8|int8|char)(?:, \d+)?>")
_TEXT = re.compile(r"string(?:<\d+>)?")


class StateBytes:
    """Reads and writes the state in a service's snapshot and restore messages.

    Raises RosError: A type cannot be loaded, or has no such field.
    """

    def __init__(self, spec: StateSpec) -> None:
        self._snapshot = load_service_type(spec.snapshot.type)
        self._restore = load_service_type(spec.restore.type)
        self._out = _Field(self._snapshot.Response, spec.snapshot, "response")
        self._in = _Field(self._restore.Request, spec.restore, "request")
        if self._out.is_text != self._in.is_text:
            raise RosError(
                f"one of `{spec.snapshot.field}` and `{spec.restore.field}` is text, "
                "the other bytes",
                "name two fields of the same kind",
            )

    def snapshot_request(self) -> bytes:
        """Return the serialised request of the snapshot service."""
        return to_bytes(self._snapshot.Request())

    def read_snapshot(self, response: bytes) -> bytes:
        """Return the state in a response of the snapshot service. Raises RosError."""
        message = from_bytes(response, self._snapshot.Response)
        _check_success(message)
        return self._out.get(message)

    def restore_request(self, state: bytes) -> bytes:
        """Return the serialised request that restores a state. Raises RosError."""
        message = self._restore.Request()
        try:
            self._in.set(message, state)
            return to_bytes(message)
        except Exception as error:  # a message's setter may raise anything
            raise RosError(f"a state of {len(state)} bytes does not fit: {error}") from error

    def check_restored(self, response: bytes) -> None:
        """Raise RosError if a response of the restore service reports a failure."""
        _check_success(from_bytes(response, self._restore.Response))


def _check_success(message: Any) -> None:
    if message.get_fields_and_field_types().get("success") == "boolean" and not message.success:
        why = str(getattr(message, "message", "") or "no reason was given")
        raise RosError(f"the service says `success: false`: {why}")


class _Field:
    """A text or byte field, by its path from the message."""

    def __init__(self, message_type: Any, where: StateService, part: str) -> None:
        *self._parents, self._name = where.field.split(".")
        message = message_type()
        for i, parent in enumerate(self._parents):
            message = getattr(message, parent, None)
            if not hasattr(message, "get_fields_and_field_types"):
                raise _no_field(where, part, ".".join(self._parents[: i + 1]))
        kind = str(message.get_fields_and_field_types().get(self._name, ""))
        sequence = _SEQUENCE.fullmatch(kind)
        self.is_text = bool(_TEXT.fullmatch(kind))
        self._element = sequence[1] if sequence else ""
        if not self.is_text and not self._element:
            raise _no_field(where, part, where.field)

    def get(self, message: Any) -> bytes:
        value = reduce(getattr, (*self._parents, self._name), message)
        if self.is_text:
            return str(value).encode()
        if self._element == "octet":  # rclpy represents these as a list of single bytes
            return b"".join(value)
        return bytes(value.tobytes())

    def set(self, message: Any, state: bytes) -> None:
        value: Any
        if self.is_text:
            value = state.decode()
        elif self._element == "octet":
            value = [state[i : i + 1] for i in range(len(state))]
        else:
            value = array.array("b" if self._element == "int8" else "B")
            value.frombytes(state)
        setattr(reduce(getattr, self._parents, message), self._name, value)


def _no_field(where: StateService, part: str, path: str) -> RosError:
    return RosError(
        f"the {part} of `{where.type}` has no text or byte field `{path}`",
        "name a field of type `string`, `uint8[]`, `int8[]`, `char[]` or `byte[]`",
    )
