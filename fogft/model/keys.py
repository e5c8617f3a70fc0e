"""Descriptions of pool file keys, each beside the dataclass field that it sets. Pure.

`key` makes a field of a specification's dataclass. The reader of the pool file, the JSON Schema,
the page `docs/reference/pool-file.md`, the ROS parameters and the proxies' configuration files
are all derived from these fields.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import MISSING, field
from enum import Enum
from functools import cache
from typing import Any, NamedTuple

DAY_S = 86_400.0
LONGEST_S = 1e7  # the longest duration that a request's header can carry


class Number(NamedTuple):
    """A number above 0, or 0 and above, up to a limit."""

    most: float
    unit: str = ""  # of a fraction: none
    from_zero: bool = False


class Whole(NamedTuple):
    """A whole number between two limits."""

    least: int
    most: int
    unit: str = ""


class Flag(NamedTuple):
    """True or false."""


class OneOf(NamedTuple):
    """An enumeration's value; `hidden` ones occur only in the proxies' configurations."""

    of: type[Enum]
    hidden: tuple[Enum, ...] = ()
    hints: Mapping[str, str] = {}  # for values of other versions


class Text(NamedTuple):
    """A string of a given form.

    With `has_parts`, proxies' configurations may hold further values that no pool file may hold,
    such as the types of an action's parts.
    """

    what: str  # description of the form, such as ``a service name``
    hint: str
    check: Callable[[str], str] = str  # returns the value to keep; raises ValueError if it is wrong
    suggest: Callable[[str], str] = lambda text: ""  # what was probably meant; empty for nothing
    has_parts: bool = False


def only(is_right: Callable[[str], object], what: str = "") -> Callable[[str], str]:
    """Return a check that accepts a text if a predicate holds; `what` describes valid texts."""

    def check(written: str) -> str:
        if not is_right(written):
            raise ValueError(f"`{written:.80}` is not {what}" if what else "")
        return written

    return check


class Listed(NamedTuple):
    """A list of distinct strings."""

    of: Text
    most: int
    least: int = 1


class Table(NamedTuple):
    """A map from strings to numbers."""

    of: Number
    name: Text


class Map(NamedTuple):
    """A map with the keys of a dataclass."""

    of: type
    hint: str = ""
    short: tuple[str, ...] = ()  # keys that a plain value in place of the map sets


class Maps(NamedTuple):
    """A list of maps with the keys of a dataclass, each with a unique name."""

    of: type
    hint: str
    most: int = 1000


class Free(NamedTuple):
    """A map that is passed on unchanged."""

    hint: str


class Special(NamedTuple):
    """Any other form: its description, its reader and its JSON Schema."""

    what: str
    read: Callable[[Any], Any]  # raises SpecError
    schema: dict[str, Any]


Form = Number | Whole | Flag | OneOf | Text | Listed | Table | Map | Maps | Free | Special


def words(form: Form) -> str:  # noqa: PLR0911
    """Describe the allowed values, for people."""
    match form:
        case Number(most, unit, from_zero):
            limits = f"{'from' if from_zero else 'above'} 0, at most {most:.10g}"
            return f"number {limits}{f' {unit}' if unit else ''}"
        case Whole(least, most, unit):
            return f"whole number, {least} to {most}{f' {unit}' if unit else ''}"
        case Flag():
            return "`true` or `false`"
        case OneOf(of, hidden):
            return " or ".join(f"`{member.value}`" for member in of if member not in hidden)
        case Text(what):
            return what
        case Listed(of, most):
            return f"list of at most {most}, each {of.what}"
        case Table(of, name):
            return f"map from {name.what} to a {words(of)}"
        case Map(_, _, short):
            return "map" + (", or one value" if short else "")
        case Maps():
            return "list of maps"
        case Free():
            return "map"
        case Special(what):
            return what
    raise AssertionError(form)


def checked(form: Form, value: Any) -> Any:
    """Check and return a value in a proxy's configuration. Raises ValueError if it is invalid."""
    match form:
        case Text() if not form.has_parts:
            try:
                return form.check(value)
            except ValueError:
                raise ValueError(f"`{value:.80}` is not {form.what}") from None
        case Listed() | Maps() if len(value) > form.most:
            raise ValueError(f"{len(value)} entries; the limit is {form.most}")
        case Listed():
            return tuple(checked(form.of, one) for one in value)
        case Number() if not 0 <= value <= max(form.most, LONGEST_S):
            raise ValueError(f"{value:g} is not from 0 to {max(form.most, LONGEST_S):g}")
        case Whole() if not form.least <= value <= form.most:
            raise ValueError(f"{value} is not from {form.least} to {form.most}")
    return value


class Key(NamedTuple):
    """The description of one key."""

    form: Form
    help: str
    name: str = ""  # the key's name, if not the field's
    usual: str = ""  # the default in words, if the value itself means nothing to users
    advanced: bool = False  # whether it belongs under `advanced`
    parameter: bool = False  # whether it is a ROS parameter of the client proxy


class Entry(NamedTuple):
    """One field of a dataclass, with its name there and in files."""

    field: str
    name: str
    key: Key
    default: Any

    @property
    def required(self) -> bool:
        """Whether the key is required."""
        return self.default is MISSING


def key(
    form: Form,
    help: str,
    *,
    default: Any = MISSING,
    default_factory: Any = MISSING,
    kw_only: bool = False,
    **more: Any,
) -> Any:
    """Return a dataclass field that is a key of the pool file; `more` sets the rest of `Key`."""
    said = {"key": Key(form, help, **more)}
    return field(default=default, default_factory=default_factory, kw_only=kw_only, metadata=said)


ORDINARY = Key(Free(""), "")
"""For a field that is not a key of the pool file: any value of its type is valid."""


def entries_of(cls: Any) -> list[Entry]:
    """Return all fields of a dataclass, in order, with their names in files."""
    found = []
    for one in dataclasses.fields(cls):
        said: Key = one.metadata.get("key", ORDINARY)
        made = one.default if one.default_factory is MISSING else one.default_factory()
        found.append(Entry(one.name, said.name or one.name, said, made))
    return found


@cache
def keys_of(cls: type) -> tuple[Entry, ...]:
    """Return the keys of a dataclass, in order; required ones first."""
    found = [entry for entry in entries_of(cls) if entry.key is not ORDINARY]
    return tuple(sorted(found, key=lambda entry: not entry.required))
