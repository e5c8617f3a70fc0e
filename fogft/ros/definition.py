"""The definition of a service type, as the Python code generated for it tells.

Owns: a type's fields and hash. Not here: comparing two definitions (`fogft.model.type_definition`).
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

from fogft.errors import RosError
from fogft.model.type_definition import REQUEST, RESPONSE, Definition, Fields, nested
from fogft.ros.types import load_service_type


def definition(type_name: str) -> Definition:
    """Return what a service type is here. One that cannot be loaded has `trouble`; never raises."""
    try:
        service_type = load_service_type(type_name)
        fields: dict[str, Fields] = {}
        for part, message in ((REQUEST, service_type.Request), (RESPONSE, service_type.Response)):
            _add(part, message, fields)
    except RosError as error:
        return Definition(trouble=error.message)
    except Exception as error:  # generated code: anything may go wrong in it
        return Definition(trouble=f"its fields cannot be read: {error!r}")
    hashes = _hashes(type_name)
    parts = [hashes.get(f"{type_name}_{part}", "") for part in ("Request", "Response")]
    return Definition(
        # Of request and response: the service's own also covers its event message, which never
        # travels and may change with the distribution.
        "+".join(parts) if all(parts) else "",
        fields,
        service_hash=hashes.get(type_name, ""),
    )


def _add(name: str, message: Any, fields: dict[str, Fields]) -> None:
    """Add a message's fields under a name, then those of what it is made of."""
    fields[name] = tuple(message.get_fields_and_field_types().items())
    for _, kind in fields[name]:
        other = nested(kind)
        if other and other not in fields:
            _add(other, _nested(other), fields)


def _nested(name: str) -> Any:
    """Return what ``package/Type`` stands for: a message, or a part of an action."""
    package, _, short = name.partition("/")
    action, _, part = short.rpartition("_")
    if action and part in ("Goal", "Result", "Feedback"):
        return getattr(getattr(importlib.import_module(f"{package}.action"), action), part)
    return getattr(importlib.import_module(f"{package}.msg"), short)


def _hashes(type_name: str) -> dict[str, str]:
    """Return type -> hash from the file that was installed with a type's code, if there is one."""
    package, _, short = type_name.split("/")
    code = Path(str(importlib.import_module(package).__file__)).resolve()
    for prefix in code.parents:
        path = prefix / "share" / package / "srv" / f"{short}.json"
        try:
            told = json.loads(path.read_text())["type_hashes"]
            return {str(one["type_name"]): str(one["hash_string"]) for one in told}
        except (OSError, ValueError, KeyError, TypeError):
            continue
    return {}
