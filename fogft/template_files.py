"""Find the `templates/` folder, and fill configuration templates in.

A template is text with ``${key}`` where a value goes, ``$$`` for a dollar. Values are
written as JSON that YAML reads the same way, so that no value, whatever it holds, can
change the structure of the file around it.

Owns: where templates are, and how values are written.
Not here: what the configurations hold (`fogft.proxy.config`) and who keeps them.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from fogft.errors import FogftError

_PLACE = re.compile(r"\$(?:\$|\{(?P<key>[a-z][a-z0-9_]*)\})?")
# What YAML counts as unprintable or as a line break, though JSON may hold it raw.
_ESCAPED = re.compile("[\x7f-\x9f\u2028\u2029\ufeff\ufffe\uffff]")


def folder() -> Path:
    """Return the folder of templates: inside the installed package, or of this checkout.

    Raises:
        FogftError: It is nowhere.
    """
    package = Path(__file__).resolve().parent
    for candidate in (package / "templates", package.parent / "templates"):
        if (candidate / "echo" / "pool.yaml").is_file():
            return candidate
    raise FogftError(
        f"the templates are missing from the installation in `{package}`",
        "install fogft again",
    )


def render(name: str, values: Mapping[str, object]) -> str:
    """Return a template of the templates' folder, filled in.

    Args:
        name: Its file name, such as ``proxy.yaml``.
        values: What to put in: text, numbers, truth values, None, and lists and maps of
            them. Each becomes one JSON value on one line.

    Raises:
        FogftError: There is no such template.
        ValueError: The keys are not exactly the template's, or a value cannot be written.
    """
    return fill(read_text(name), values, name)


def read_text(name: str) -> str:
    """Return a template of the templates' folder as it stands there.

    Raises:
        FogftError: There is no such template, or it cannot be read.
    """
    path = folder() / name
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise FogftError(f"the template `{path}` cannot be read: {reason}") from error


def fill(text: str, values: Mapping[str, object], name: str = "template") -> str:
    """Return a template's text, filled in.

    Raises:
        ValueError: As for `render`; the message begins with `name`.
    """
    wanted: set[str] = set()
    for match in _PLACE.finditer(text):
        if match["key"]:
            wanted.add(match["key"])
        elif match[0] != "$$":
            line = text.count("\n", 0, match.start()) + 1
            raise ValueError(f"{name}:{line}: a `$` that begins no `${{key}}`; write `$$`")
    missing, unused = sorted(wanted - values.keys()), sorted(values.keys() - wanted)
    if missing or unused:
        raise ValueError(f"{name}: missing values {missing}, unused values {unused}")
    return _PLACE.sub(lambda match: literal(values[match["key"]]) if match["key"] else "$", text)


def literal(value: object) -> str:
    """Return a value as one line that JSON and YAML read alike.

    Raises:
        ValueError: It is not finite, not valid text, or of a type that JSON lacks.
    """
    if value is None or isinstance(value, (bool, int)):
        return json.dumps(value)
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, Mapping):
        pairs = (f"{_text(_key(key))}: {literal(child)}" for key, child in value.items())
        return "{" + ", ".join(pairs) + "}"
    if isinstance(value, Sequence) and not isinstance(value, (bytes, bytearray)):
        return "[" + ", ".join(literal(child) for child in value) + "]"
    raise ValueError(f"a {type(value).__name__} cannot be written into a template")


def _number(value: float) -> str:
    if not math.isfinite(value):
        raise ValueError(f"{value} cannot be written into a template")
    text = repr(value)
    # YAML 1.1 reads `1e-07` as text; with a point it is a number in both.
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return text


def _text(value: str) -> str:
    value.encode()  # a lone surrogate raises UnicodeEncodeError, a ValueError
    quoted = json.dumps(value, ensure_ascii=False)
    return _ESCAPED.sub(lambda match: f"\\u{ord(match[0]):04x}", quoted)


def _key(key: object) -> str:
    if not isinstance(key, str):
        raise ValueError(f"{key!r} cannot be a key")  # noqa: TRY004
    return key
