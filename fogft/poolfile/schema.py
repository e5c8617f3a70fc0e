"""The JSON Schema (draft 2020-12) of the pool file, for completion in editors. Pure."""

from typing import Any

from fogft.model import keys
from fogft.model.keys import Form, keys_of
from fogft.model.spec import PoolSpec
from fogft.poolfile.reader import ADVANCED
from fogft.poolfile.task import TASK_KEYS

FILE = "pool.schema.json"


def pool_schema() -> dict[str, Any]:
    """Return the schema of a pool file."""
    definitions: dict[str, Any] = {}
    ours = _map(PoolSpec, definitions)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "fogft pool file",
        "description": "A SkyPilot task with a `fogft` section.",
        "type": "object",
        "properties": {
            **{key: {"description": "As in a SkyPilot task."} for key in TASK_KEYS},
            "name": {"type": "string", "pattern": "^[a-z0-9-]{1,40}$"},
            "run": {"type": "string", "description": "Command that starts the services."},
            "fogft": ours,
        },
        "required": ["run", "fogft"],
        "additionalProperties": False,
        "$defs": definitions,
    }


def _map(cls: type, definitions: dict[str, Any]) -> dict[str, Any]:
    if cls.__name__ not in definitions:
        definitions[cls.__name__] = {}  # reserved, for classes that contain themselves
        entries = keys_of(cls)
        parts: dict[bool, dict[str, Any]] = {False: {}, True: {}}
        for entry in entries:
            described = _form(entry.key.form, definitions) | {"description": entry.key.help}
            if isinstance(entry.default, (bool, int, float, str)) and entry.default not in ("", 0):
                described["default"] = getattr(entry.default, "value", entry.default)
            parts[entry.key.advanced][entry.name] = described
        properties, advanced = parts[False], parts[True]
        if advanced:
            below = {"type": "object", "properties": advanced, "additionalProperties": False}
            properties[ADVANCED] = {**below, "description": "Keys that are rarely set."}
        definitions[cls.__name__] = {
            "type": "object",
            "properties": properties,
            "required": [entry.name for entry in entries if entry.required],
            "additionalProperties": False,
        }
    return {"$ref": f"#/$defs/{cls.__name__}"}


def _form(form: Form, definitions: dict[str, Any]) -> dict[str, Any]:  # noqa: PLR0911
    match form:
        case keys.Number(most, _, from_zero):
            least = {"minimum": 0} if from_zero else {"exclusiveMinimum": 0}
            return {"type": "number", **least, "maximum": most}
        case keys.Whole(least, most):
            return {"type": "integer", "minimum": least, "maximum": most}
        case keys.Flag():
            return {"type": "boolean"}
        case keys.OneOf(of, hidden):
            return {"enum": [member.value for member in of if member not in hidden]}
        case keys.Text():
            return {"type": "string", "minLength": 1}
        case keys.Listed(of, most, least):
            items = _form(of, definitions)
            return {"type": "array", "items": items, "minItems": least, "maxItems": most}
        case keys.Table(of):
            return {"type": "object", "additionalProperties": _form(of, definitions)}
        case keys.Map(of, _, short):
            forms = [entry.key.form for entry in keys_of(of) if entry.name in short[:1]]
            choices = [_map(of, definitions), *(_form(one, definitions) for one in forms)]
            return choices[0] if len(choices) == 1 else {"anyOf": choices}
        case keys.Maps(of, _, most):
            items = _map(of, definitions)
            return {"type": "array", "items": items, "minItems": 1, "maxItems": most}
        case keys.Free():
            return {"type": "object"}
        case keys.Special():
            return dict(form.schema)
    raise AssertionError(form)
