"""Definitions of service and message types, and the differences between two of the same name. Pure.

The robot and a replica load a type by its name, each from its own workspace: bytes of a different
definition would decode to plausible but wrong values. With distributions that have type hashes
(Iron and later) the hashes are compared; otherwise, or to say what differs, the fields are.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

from fogft.model.keys import only
from fogft.model.plain import Line

REQUEST, RESPONSE, MESSAGE = "request", "response", "message"
_HASH = re.compile(r"\w*", re.ASCII)
_NESTED = re.compile(r"(?:sequence<)?([A-Za-z]\w*/[A-Za-z]\w*)")

Fields = tuple[tuple[Line, Line], ...]


@dataclass(frozen=True)
class Definition:
    """The definition of a service or message type on one machine. Hashes are empty where not known.

    `fields` has the names and types, in order, of `REQUEST` and `RESPONSE`, or of `MESSAGE`, and of
    each nested ``package/Message``, as the generated Python code lists them. `service_hash` covers
    the whole service including its event message, as in the names that `rmw_zenoh` uses.
    """

    hash: Line = ""  # of request and response: ``RIHS01_...+RIHS01_...``
    fields: Mapping[Line, Fields] = field(default_factory=dict)
    trouble: Line = ""
    service_hash: Annotated[str, only(_HASH.fullmatch)] = ""  # it becomes part of a Zenoh key

    @property
    def known(self) -> bool:
        """Whether the definition is known."""
        return bool(self.hash or self.fields or self.trouble or self.service_hash)


def nested(kind: str) -> str:
    """Return the message type within a field's type; empty for numbers and strings."""
    found = _NESTED.match(kind)
    return found.group(1) if found else ""


def difference(type_name: str, here: Definition, there: Definition) -> str:
    """Return how a type differs between here and a replica, in words; empty if it is the same."""
    for side, definition in (("here", here), ("on the replica", there)):
        if definition.trouble:
            return f"`{type_name}` cannot be loaded {side}: {definition.trouble}"
    if here.hash and here.hash == there.hash:
        return ""
    if not (here.fields and there.fields):  # on one side only the hash is known
        return _of_hashes(type_name, here.service_hash, there.service_hash)
    for part in (REQUEST, RESPONSE, MESSAGE):
        found = _first_difference(part, part, here, there, set())
        if found:
            return f"`{type_name}` is not the same: {found}"
    return _of_hashes(type_name, here.hash, there.hash)


def _of_hashes(type_name: str, here: str, there: str) -> str:
    comparable = here and there and here.partition("_")[0] == there.partition("_")[0]
    if not comparable or here == there:
        return ""
    return f"`{type_name}` is not the same: its hash is {here} here, {there} there"


def _first_difference(
    path: str, of: str, here: Definition, there: Definition, seen: set[str]
) -> str:
    if of in seen:
        return ""
    seen.add(of)
    ours, theirs = here.fields.get(of, ()), there.fields.get(of, ())
    found = _of_fields(path, ours, theirs)
    for name, kind in ours:
        found = found or _first_difference(f"{path}.{name}", nested(kind), here, there, seen)
    return found


def _of_fields(path: str, ours: Fields, theirs: Fields) -> str:
    kinds_here, kinds_there = dict(ours), dict(theirs)
    for name, kind in ours:
        other = kinds_there.get(name)
        if other is None:
            return f"field `{path}.{name}` (`{kind}`) is missing on the replica"
        if kind != other:
            return f"field `{path}.{name}` is `{kind}` here and `{other}` on the replica"
    for name, kind in theirs:
        if name not in kinds_here:
            return f"the replica has a further field `{path}.{name}` (`{kind}`)"
    for (name, _), (other, _) in zip(ours, theirs, strict=False):
        if name != other:
            return f"the order of fields differs: `{path}.{name}` here, `{path}.{other}` there"
    return ""
