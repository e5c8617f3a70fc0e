"""ROS 2's rules for names in a pool file. Pure: nothing is looked up.

tests/ros/test_service_names compares them with what ROS itself accepts.

Source: the ROS 2 design documents on topic and service names and on interface
definitions; `rmw_validate_full_topic_name` and rosidl's own patterns.
"""

import re
from functools import partial

from fogft.model.keys import Text, only

MAX_SERVICE_NAME = 240  # DDS allows 255; ROS adds a prefix and a suffix
_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_FIELD = re.compile(r"(?!.*__)(?!.*_$)[a-z][a-z0-9_]*")
_INTERFACE = re.compile(r"[A-Z][A-Za-z0-9]*")


def absolute_service_name(name: str) -> str:
    """Return a service's absolute name: ``detect`` becomes ``/detect``. Raises ValueError."""
    if name.startswith("~") or "{" in name:
        raise ValueError("private names and substitutions need a node; write the full name")
    absolute = name if name.startswith("/") else "/" + name
    if len(absolute) > MAX_SERVICE_NAME:
        raise ValueError(f"it is longer than {MAX_SERVICE_NAME} characters")
    for token in absolute[1:].split("/"):
        if not token:
            raise ValueError("the part between or after slashes is empty")
        if token[0].isdigit():
            raise ValueError("a part begins with a digit")
        if not _TOKEN.fullmatch(token):
            raise ValueError("only letters, digits, `_` and `/` are allowed")
    return absolute


def is_below(name: str, namespace: str) -> bool:
    """Whether an absolute name is in a namespace or below it; the empty one contains all names."""
    return name.startswith(namespace.rstrip("/") + "/")


def _is_type(name: str, kind: str) -> bool:
    parts = name.split("/")
    return (
        len(parts) == 3
        and is_field_name(parts[0])  # a package's name has the same form
        and parts[1] == kind
        and bool(_INTERFACE.fullmatch(parts[2]))
    )


is_service_type = partial(_is_type, kind="srv")  # ``package/srv/Name``
is_message_type = partial(_is_type, kind="msg")
is_action_type = partial(_is_type, kind="action")


# Packages of services that nodes have anyway: parameters, loggers, types, life cycle.
_OF_ROS = frozenset(("rcl_interfaces", "type_description_interfaces", "lifecycle_msgs"))


def is_application(node: str) -> bool:
    """Whether a node belongs to an application: not hidden (like ros2cli's daemon), not a proxy."""
    return not node.startswith(("_", "fogft_"))


def is_of_application(name: str, type_name: str) -> bool:
    """Whether a service is an application's own: not one of ROS itself, hidden, or an action's."""
    if not is_service_type(type_name) or type_name.partition("/")[0] in _OF_ROS:
        return False
    return not any(token.startswith("_") for token in name.split("/"))


def suggested_service_type(name: str) -> str:
    """Return the service type that was probably meant, or an empty text."""
    parts = [part for part in re.split(r"[./:]+", name.strip()) if part]
    if len(parts) == 2:
        parts.insert(1, "srv")
    if len(parts) == 3 and parts[1] == "srvs":
        parts[1] = "srv"
    guess = "/".join(parts)
    return guess if is_service_type(guess) else ""


def is_field_name(name: str) -> bool:
    """Whether a ROS message may have a field of this name."""
    return bool(_FIELD.fullmatch(name))


def service_name(hint: str, what: str = "a service name") -> Text:
    """Return the form of a key that holds the name of a service, topic or action."""
    return Text(what, hint, absolute_service_name)


def service_type(hint: str, *, has_parts: bool = False) -> Text:
    """Return the form of a key that holds a service type."""
    return Text(
        *("a service type", hint, only(is_service_type), suggested_service_type),
        has_parts=has_parts,
    )


def field_path(hint: str) -> Text:
    """Return the form of a key that holds the path of a field, such as ``plan.cost``."""
    is_path = only(lambda written: all(map(is_field_name, written.split("."))))
    return Text("the path of a field", hint, is_path)
