"""A specification as plain values: what a pool file or a proxy's configuration says of it. Pure.

Defaults are left out, so that a configuration stays short and one written by an older manager
means what it meant. `Reader(internal=True)` is the way back.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from fogft.model import keys
from fogft.model.keys import Form, keys_of
from fogft.poolfile.reader import Reader
from fogft.poolfile.tree import Section, tree

T = TypeVar("T")


def to_plain(value: Any, *, on_replica: bool = False) -> dict[str, Any]:
    """Return what a file says of a specification.

    Args:
        value: Of a dataclass whose fields are keys.
        on_replica: Only what a replica needs to know.
    """
    written: dict[str, Any] = {}
    for entry in keys_of(type(value)):
        held = value
        for name in entry.path:
            held = getattr(held, name)
        if held != entry.default and (entry.key.on_replica or not on_replica):
            written[entry.name] = _plain(entry.key.form, held)
    return written


def _plain(form: Form, held: Any) -> Any:  # noqa: PLR0911
    if held is None:
        return False
    match form:
        case keys.OneOf():
            return held.value
        case keys.Listed():
            return list(held)
        case keys.Table() | keys.Free():
            return dict(held)
        case keys.Map():
            return to_plain(held)
        case keys.Maps():
            return [to_plain(one) for one in held]
        case keys.Special() as special:
            return special.plain(held)
    return held


def from_plain(cls: type[T], raw: Mapping[str, Any], file: str = "configuration") -> T:
    """Return the specification that plain values describe.

    Raises:
        SpecError: They describe none.
    """
    return Reader({}, internal=True).map(cls, Section(file, "", tree(raw)))
