"""The JSON Schema (draft 2020-12) of ``fogft status --json``, from the status's own fields.

A version of the schema only ever gains keys, and words where none are listed. Whatever would take
one away or change what it means raises `status.VERSION`.
"""

from __future__ import annotations

import typing
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from types import NoneType, UnionType
from typing import Any

from fogft.model.reason import Reason
from fogft.pool.commands.status import Seen
from fogft.pool.manager.status import PoolStatus

_PLAIN = {str: "string", int: "integer", float: "number", bool: "boolean", NoneType: "null"}


def status_schema() -> dict[str, Any]:
    """Return the schema."""
    definitions: dict[str, Any] = {}
    own = _object(PoolStatus, definitions)
    of_reader = _object(Seen, definitions)
    properties = {**own["properties"], **of_reader["properties"]}
    del properties["status"]  # what it holds stands beside the others
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "fogft status --json",
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "$defs": definitions,
    }


def _object(cls: type[Any], definitions: dict[str, Any]) -> dict[str, Any]:
    hints = typing.get_type_hints(cls)
    # A reason has the data that belongs to its cause; everything else has all of its keys.
    required = ["cause"] if cls is Reason else [field.name for field in fields(cls)]
    properties = {}
    for field in fields(cls):
        properties[field.name] = _form(hints[field.name], definitions)
        words = field.metadata.get("words")
        if words is not None:
            properties[field.name]["enum"] = list(words)
    return {"type": "object", "properties": properties, "required": required}


def _form(hint: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    if hint in _PLAIN:
        return {"type": _PLAIN[hint]}
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, UnionType):
        return {"anyOf": [_form(one, definitions) for one in arguments]}
    if origin in (Sequence, tuple):
        return {"type": "array", "items": _form(arguments[0], definitions)}
    if origin is Mapping:
        return {"type": "object"}
    if isinstance(hint, type) and issubclass(hint, Enum):
        return {"type": "string", "examples": [one.value for one in hint]}
    if isinstance(hint, type) and is_dataclass(hint):
        name = hint.__name__
        if name not in definitions:
            definitions[name] = {}  # a name for those that contain themselves
            definitions[name] = _object(hint, definitions)
        return {"$ref": f"#/$defs/{name}"}
    raise TypeError(f"`{hint}` has no JSON form")
