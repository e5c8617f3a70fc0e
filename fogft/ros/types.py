"""Service and message types by name: loading, fields, hashes and checks.

Loading a type needs its interface package but not rclpy, so the pool file's reader can check
a type without starting ROS.

Owns: names of types, their errors and hints, shapes, definitions.
Not here: messages (`messages`), comparing two definitions (`fogft.model.type_definition`).
"""

import contextlib
import difflib
import importlib
import json
import os
import re
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

from fogft.errors import RosError
from fogft.model.cdr import Shape
from fogft.model.plain import as_line
from fogft.model.type_definition import MESSAGE, REQUEST, RESPONSE, Definition, Fields, nested

_NAME = re.compile(
    r"[a-z][a-z0-9_]*/(srv/[A-Z][A-Za-z0-9]*|action/[A-Z][A-Za-z0-9]*_(SendGoal|GetResult))"
)
_MESSAGE = re.compile(
    r"[a-z][a-z0-9_]*/(msg/[A-Z][A-Za-z0-9]*|action/[A-Z][A-Za-z0-9]*_FeedbackMessage)"
)


def load_service_type(name: str) -> Any:
    """Return the Python class of ``package/srv/Type`` with its type support loaded.

    Raises RosError: There is no such type here, or it cannot be loaded; with a hint.
    """
    if not _NAME.fullmatch(name):
        raise RosError(
            f"`{name}` is not the name of a service type",
            f"write `package/srv/Type`, as in `std_srvs/srv/SetBool`.{_did_you_mean(name)}",
        )
    service_type = _find(name)
    _load_type_support(name, service_type, service_type.Request, service_type.Response)
    return service_type


def load_message_type(name: str) -> Any:
    """Return the Python class of ``package/msg/Type``, or of an action's feedback message.

    Raises RosError: There is no such type here, or it cannot be loaded; with a hint.
    """
    if not _MESSAGE.fullmatch(name):
        example = "write `package/msg/Type`, as in `sensor_msgs/msg/Image`"
        raise RosError(f"`{name}` is not the name of a message type", example)
    message_type = _find(name)
    _load_type_support(name, message_type)
    return message_type


def load_type(name: str) -> Any:
    """Return the Python class of a service or message type. Raises RosError."""
    return load_message_type(name) if "/msg/" in name else load_service_type(name)


def trouble(make: Callable[..., object], *arguments: Any) -> RosError | None:
    """Return why a ROS object cannot be created here; None if it can."""
    try:
        make(*arguments)
    except RosError as error:
        return error
    except ImportError as error:
        hint = "install `fogft[ros]` or source a ROS 2 installation"
        return RosError(f"ROS 2 cannot be used here: {error}", hint)
    return None


# The end of an action part's type name -> the attribute of the action's `Impl`.
_PARTS = {
    "SendGoal": "SendGoalService",
    "GetResult": "GetResultService",
    "FeedbackMessage": "FeedbackMessage",
}


def _find(name: str) -> Any:
    """Return the Python class of a type, or of a part of an action. Raises RosError."""
    package, kind, type_name = name.split("/")
    type_name, _, part = type_name.partition("_")
    name = f"{package}/{kind}/{type_name}"  # not the part: users know only the action
    try:
        found = getattr(importlib.import_module(f"{package}.{kind}"), type_name)
        return getattr(found.Impl, _PARTS[part]) if part else found
    except AttributeError as error:
        raise RosError(
            f"package `{package}` has no {_KINDS[kind]} type `{type_name}`",
            f"is the sourced workspace's build up to date?{_did_you_mean(name)}",
        ) from error
    except Exception as error:  # generated code: anything may go wrong in it
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing not in (package, f"{package}.{kind}"):
            raise RosError(f"`{name}` cannot be loaded: {error}", _SOURCE_HINT) from error
        raise RosError(
            f"there is no package `{package}` with {_KINDS[kind]}s here, "
            f"so `{name}` cannot be loaded",
            "install the package, or source its workspace; ROS 2's own are in "
            f"`fogft[ros]`.{_did_you_mean(name)}",
        ) from error


_KINDS = {"srv": "service", "msg": "message", "action": "action"}
_SOURCE_HINT = "source the ROS 2 installation and the workspace that this type was built with"


def _load_type_support(name: str, *parts: Any) -> None:
    for part in parts:
        try:
            if type(part)._TYPE_SUPPORT is None:
                type(part).__import_type_support__()
        except Exception as error:
            raise RosError(
                f"the C library of `{name}` is missing: {error}", _SOURCE_HINT
            ) from error
        if type(part)._TYPE_SUPPORT is None:
            raise RosError(f"the C library of `{name}` cannot be loaded", _SOURCE_HINT)


def installed_service_types() -> list[str]:
    """Return the names of the service types that the ament index lists here, sorted."""
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    found: set[str] = set()
    for prefix in filter(None, prefixes):
        index = Path(prefix, "share", "ament_index", "resource_index", "rosidl_interfaces")
        with contextlib.suppress(OSError):
            for package in index.iterdir():
                found.update(
                    f"{package.name}/{line.removesuffix('.srv')}"
                    for line in package.read_text().split()
                    if line.startswith("srv/") and line.endswith(".srv")
                )
    return sorted(found)


def _did_you_mean(name: str) -> str:
    known = installed_service_types()
    by_type = [full for full in known if full.rsplit("/", 1)[1] == name.rsplit("/", 1)[-1]]
    close = by_type[:1] or difflib.get_close_matches(name, known, n=1, cutoff=0.75)
    return f" Did you mean `{close[0]}`?" if close else ""


def definition(type_name: str) -> Definition:
    """Return a type's definition here, with `trouble` if it fails; never raises."""
    fields: dict[str, Fields] = {}
    try:
        if _MESSAGE.fullmatch(type_name):
            _add(MESSAGE, load_message_type(type_name), fields)
            return Definition(fields=fields)
        service_type = load_service_type(type_name)
        for part, message in ((REQUEST, service_type.Request), (RESPONSE, service_type.Response)):
            _add(part, message, fields)
    except RosError as error:
        return Definition(trouble=as_line(error.message))
    except Exception as error:  # generated code: anything may go wrong in it
        return Definition(trouble=as_line(f"its fields cannot be read: {error!r}"))
    hashes = _hashes(type_name)
    parts = [hashes.get(f"{type_name}_{part}", "") for part in ("Request", "Response")]
    return Definition(
        # Of request and response: the service's own hash also covers its event message, which is
        # never sent and may differ between distributions.
        "+".join(parts) if all(parts) else "",
        fields,
        service_hash=hashes.get(type_name, ""),
    )


@lru_cache(maxsize=256)
def shape(message_type: Any) -> Shape:
    """Return the shape of a message's bytes; it knows only the header if fields cannot be read."""
    fields: dict[str, Fields] = {}
    try:
        _add("", message_type, fields)
    except Exception:  # generated code: anything may go wrong in it
        fields.clear()
    return Shape("", fields)


def _add(name: str, message: Any, fields: dict[str, Fields]) -> None:
    """Add a message's fields under a name, then those of its nested types."""
    fields[name] = tuple(message.get_fields_and_field_types().items())
    for _, kind in fields[name]:
        other = nested(kind)
        if other and other not in fields:
            _add(other, nested_type(other), fields)


def nested_type(name: str) -> Any:
    """Return the message, or part of an action, that ``package/Type`` names."""
    package, _, short = name.partition("/")
    action, _, part = short.rpartition("_")
    if action and part in ("Goal", "Result", "Feedback"):
        return getattr(getattr(importlib.import_module(f"{package}.action"), action), part)
    return getattr(importlib.import_module(f"{package}.msg"), short)


def _hashes(type_name: str) -> dict[str, str]:
    """Return type -> hash from the file installed with a type's code; empty if there is none."""
    package, _, short = type_name.split("/")
    code = Path(str(importlib.import_module(package).__file__)).resolve()
    for prefix in code.parents:
        path = prefix / "share" / package / "srv" / f"{short}.json"
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            told = json.loads(path.read_text())["type_hashes"]
            return {str(one["type_name"]): str(one["hash_string"]) for one in told}
    return {}
