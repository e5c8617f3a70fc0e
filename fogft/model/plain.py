"""Values as plain JSON data, and back. Pure.

A dataclass says by the types of its fields what may stand where, and nothing else
has to. An `Annotated` type has checks besides, and a key of a pool file the check of its form.
Keys that a class does not know are left alone: a newer program may have written them.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import Enum
from functools import partial
from typing import Annotated, Any, TypeVar

from fogft.errors import StateError
from fogft.model import keys

T = TypeVar("T")
Read = Callable[[Any], Any]

_READERS: dict[Any, Read] = {}


def _not_negative(value: float) -> None:
    if not 0 <= value < float("inf"):  # false for NaN too
        raise ValueError(f"{value!r:.40} is below 0, or no number")


Count = Annotated[int, _not_negative]
Moment = Annotated[float, _not_negative]  # seconds since the epoch


def to_plain(value: Any) -> Any:
    """Return a value as JSON data: classes as maps, a set sorted.

    A class with `omits_defaults` is written without the fields that have their defaults.
    """
    if isinstance(value, Enum):
        return value.value
    if dataclasses.is_dataclass(value):
        omits = getattr(value, "omits_defaults", False)
        held = ((name, default, getattr(value, name)) for name, default in _fields(type(value)))
        return {name: to_plain(one) for name, default, one in held if not omits or one != default}
    if isinstance(value, Mapping):
        return {str(key): to_plain(one) for key, one in value.items()}
    if isinstance(value, (set, frozenset)):
        return sorted(map(to_plain, value))
    return [to_plain(one) for one in value] if isinstance(value, (list, tuple)) else value


def from_plain(cls: type[T], raw: Any) -> T:
    """Return the value that JSON data describes.

    Raises:
        ValueError: It describes none of this class.
    """
    try:
        made: T = _reader(cls)(raw)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error
    return made


def stored(cls: type[T], raw: Any, what: str) -> T:
    """Return the value that JSON data of ours describes.

    Raises:
        StateError: It describes none; the message begins with ``what``.
    """
    try:
        return from_plain(cls, raw)
    except ValueError as error:
        raise StateError(f"{what}: {error}") from error


def _fields(cls: Any) -> Iterable[tuple[str, Any]]:
    """Return the names of a class's fields, each with its default."""
    return [
        (f.name, f.default if f.default_factory is dataclasses.MISSING else f.default_factory())
        for f in dataclasses.fields(cls)
    ]


def _reader(hint: Any) -> Read:
    if hint not in _READERS:
        _READERS[hint] = partial(from_plain, hint)  # for one that contains itself
        _READERS[hint] = _made(hint)
    return _READERS[hint]


def _made(hint: Any) -> Read:  # noqa: PLR0911
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return lambda raw: raw
    if origin is Annotated:
        return _checked(_reader(arguments[0]), arguments[1:])
    if origin in (typing.Union, types.UnionType):
        (one,) = (_reader(kind) for kind in arguments if kind is not types.NoneType)
        return lambda raw: None if raw is None else one(raw)
    if origin is tuple and arguments[-1] is not ...:
        return _fixed([_reader(kind) for kind in arguments])
    if origin in (tuple, frozenset, Sequence, list):
        return _listed(list if origin is Sequence else origin, _reader(arguments[0]))
    if origin is Mapping:
        return _map(int if arguments[0] is int else _reader(str), _reader(arguments[1]))
    if issubclass(hint, Enum):
        by_value: Read = hint
        return by_value
    if dataclasses.is_dataclass(hint):
        return _class(hint)
    return _scalar(hint)


def _scalar(kind: Any) -> Read:
    allowed = (int, float) if kind is float else (kind,)

    def read(raw: Any) -> Any:
        if not isinstance(raw, allowed) or (isinstance(raw, bool) and kind is not bool):
            raise ValueError(f"{raw!r:.40} is not of type `{kind.__name__}`")
        if isinstance(raw, str):
            raw.encode()  # a lone surrogate cannot be written again
        return kind(raw)

    return read


def _checked(read: Read, checks: Iterable[Callable[[Any], object]]) -> Read:
    def checked(raw: Any) -> Any:
        value = read(raw)
        for check in checks:
            check(value)
        return value

    return checked


def _list(raw: Any) -> list[Any]:
    if not isinstance(raw, list):
        raise ValueError(f"{raw!r:.40} is not a list")  # noqa: TRY004
    return raw


def _fixed(reads: list[Read]) -> Read:
    return lambda raw: tuple(read(one) for read, one in zip(reads, _list(raw), strict=True))


def _listed(make: Callable[[Iterable[Any]], Any], read: Read) -> Read:
    return lambda raw: make(read(one) for one in _list(raw))


def _map(key: Read, read: Read) -> Read:
    return lambda raw: {key(name): read(one) for name, one in _items(raw)}


def _items(raw: Any) -> Iterable[tuple[Any, Any]]:
    if not isinstance(raw, dict):
        raise ValueError(f"{raw!r:.40} is not a map")  # noqa: TRY004
    return raw.items()


def _class(cls: Any) -> Read:
    hints = typing.get_type_hints(cls, include_extras=True)
    reads = {name: _reader(hints[name]) for name, _ in _fields(cls)}
    required = [name for name, default in _fields(cls) if default is dataclasses.MISSING]
    for entry in keys.keys_of(cls):
        reads[entry.path[0]] = _of_form(entry.key.form, reads[entry.path[0]])

    def read(raw: Any) -> Any:
        found = {name: reads[name](one) for name, one in _items(raw) if name in reads}
        missing = [name for name in required if name not in found]
        if missing:
            raise ValueError(f"`{missing[0]}` is missing")
        return cls(**found)

    return read


def _of_form(form: keys.Form, read: Read) -> Read:
    """Return a reader of a pool file's key that keeps to what its form allows."""
    if isinstance(form, keys.Text):
        return _checked(read, [form.check])

    def check(values: Sequence[str]) -> None:
        if isinstance(form, (keys.Listed, keys.Maps)) and len(values) > form.most:
            raise ValueError(f"{len(values)} entries, where {form.most} are the limit")
        if isinstance(form, keys.Listed):
            for value in values:
                form.of.check(value)

    return _checked(read, [check]) if isinstance(form, (keys.Listed, keys.Maps)) else read
