"""Compare two serialised responses field by field, floats with tolerance.

Bytes cannot be compared: the padding of CDR is whatever lay in memory. So both are made
Python messages, which plain services never need.

Owns: reading and comparing responses of one type. Not here: votes (`fogft.requests.votes`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

from fogft.errors import RosError
from fogft.model.type_definition import nested
from fogft.ros.messages import from_bytes
from fogft.ros.types import load_service_type, nested_type

_FLOAT = re.compile(r"(sequence<)?(float|double)\b.*")  # one, or a list of them


class Comparison:
    """Compares responses of a service type.

    Args:
        tolerances: Path of a float field -> how far two values may be apart. A path leads
            through lists as through their elements. All else must be equal.

    Raises:
        RosError: The type cannot be loaded, or has no such float field.
    """

    def __init__(self, type_name: str, tolerances: Mapping[str, float]) -> None:
        self._response = load_service_type(type_name).Response
        self._tolerances = dict(tolerances)
        for path in tolerances:
            _check_float(self._response, type_name, path)

    def read(self, payload: bytes) -> Any:
        """Return the message. Raises Unreadable."""
        return from_bytes(payload, self._response)

    def agree(self, one: Any, other: Any, path: str = "") -> bool:
        """Whether two messages, or parts at a path, are the same within the tolerances.

        NaN agrees with NaN.
        """
        if isinstance(one, float):
            close = abs(one - other) <= self._tolerances.get(path, 0.0)
            return one == other or close or (math.isnan(one) and math.isnan(other))
        if hasattr(one, "get_fields_and_field_types"):
            prefix = f"{path}." if path else ""
            return all(
                self.agree(getattr(one, name), getattr(other, name), prefix + name)
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
        return all(self.agree(_plain(a), _plain(b), path) for a, b in zip(one, other, strict=True))


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
