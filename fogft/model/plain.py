"""Convert values to plain JSON data and back. Pure.

The types of a dataclass's fields define the accepted data. An `Annotated` type adds checks, and a
key of a pool file the check of its form. Unknown keys are ignored: a newer version may have
written them.
"""

import dataclasses
import datetime
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import Enum
from functools import cache, partial
from pathlib import Path, PurePath
from typing import Annotated, Any, TypeVar

from fogft.errors import StateError
from fogft.model import keys

T = TypeVar("T")
Read = Callable[[Any], Any]

LINE_LIMIT = 1000  # characters
_MOST = 1e300  # larger numbers would overflow in arithmetic


class Misfit(ValueError):
    """Data does not fit a class; `path` locates the problem."""

    def __init__(self, path: tuple[str | int, ...], what: str) -> None:
        parts = (f"[{part}]" if isinstance(part, int) else f".{part:.40}" for part in path)
        self.path, self.what = path, what
        super().__init__(f"{''.join(parts).lstrip('.')}: {what}")


def within(least: float, most: float) -> Callable[[float], None]:
    """Return a check for `Annotated` that a number is from `least` to `most`."""

    def check(value: float) -> None:
        if not least <= value <= most:  # also refuses NaN
            raise ValueError(f"{value!r:.40} is not from {least:g} to {most:g}")

    return check


Count = Annotated[int, within(0, 2**53)]
Generation = Annotated[int, within(1, 1 << 31)]


def as_line(text: str) -> str:
    """Return a text as one short printable line, the only form that peers accept."""
    text = text[:LINE_LIMIT]
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else "?" for c in " ".join(text.split()))


def _check_line(text: str) -> None:
    if not text.isprintable():
        raise ValueError("it holds what cannot be printed")
    if len(text) > LINE_LIMIT:
        raise ValueError(f"it has {len(text)} characters, at most {LINE_LIMIT}")


Line = Annotated[str, _check_line]  # it may reach a terminal: no escape sequence, no line break
Seconds = Annotated[float, within(0, 1e12)]  # a duration
Moment = Annotated[float, within(0, 2.5e11)]  # seconds since the epoch: a year of four digits


def utc(moment: float) -> str:
    """Return a time as ``2026-11-23 18:05 UTC``."""
    at = datetime.datetime.fromtimestamp(moment, datetime.timezone.utc)
    return f"{at:%Y-%m-%d %H:%M} UTC"


def to_plain(value: Any, *, omit_defaults: bool = False) -> Any:
    """Return a value as JSON data: dataclasses as maps by key name, sets as sorted lists.

    With `omit_defaults`, or for a class with `omits_defaults`, default values are left out.
    """
    again = partial(to_plain, omit_defaults=omit_defaults)
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, PurePath):
        return str(value)
    if dataclasses.is_dataclass(value):
        omits = omit_defaults or getattr(value, "omits_defaults", False)
        held = [(one, getattr(value, one.field)) for one in keys.entries_of(type(value))]
        kept = [(one, it) for one, it in held if not omits or it != one.default]
        return {one.name: again(it) for one, it in kept}
    if isinstance(value, Mapping):
        return {str(key): again(one) for key, one in value.items()}
    if isinstance(value, (set, frozenset)):
        return sorted(map(again, value))
    return [again(one) for one in value] if isinstance(value, (list, tuple)) else value


def from_plain(cls: type[T], raw: Any) -> T:
    """Return the value that JSON data describes. Raises ValueError that begins with the key."""
    hint: Any = cls
    try:
        made: T = _reader(hint)(raw)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error
    return made


def stored(cls: type[T], raw: Any, what: str, hint: str = "") -> T:
    """Like `from_plain` for fogft's own files: raises StateError, which begins with `what`."""
    try:
        return from_plain(cls, raw)
    except ValueError as error:
        raise StateError(f"{what}: {error}", hint) from error


@cache
def _reader(hint: Any) -> Read:  # noqa: PLR0911
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return lambda raw: raw
    if origin is Annotated:
        return _checked(_reader(arguments[0]), arguments[1:])
    if origin in (typing.Union, types.UnionType):
        (one,) = (_reader(kind) for kind in arguments if kind is not types.NoneType)
        return lambda raw: None if raw is None else one(raw)
    if origin is tuple and arguments[-1] is not ...:
        reads = [_reader(kind) for kind in arguments]
        return lambda raw: tuple(read(one) for read, one in zip(reads, _list(raw), strict=True))
    if origin in (tuple, frozenset, Sequence, list):
        make, read = list if origin is Sequence else origin, _reader(arguments[0])
        return lambda raw: make(_at(n, read, one) for n, one in enumerate(_list(raw)))
    if origin in (Mapping, dict):
        key = int if arguments[0] is int else _reader(arguments[0])
        of = _reader(arguments[1])
        return lambda raw: {key(name): _at(name, of, one) for name, one in _items(raw)}
    if issubclass(hint, Enum):
        return _by_value(hint)
    if dataclasses.is_dataclass(hint):
        return partial(_class, hint)
    if hint is Path:
        return _path
    return _scalar(hint)


def _scalar(kind: Any) -> Read:
    allowed = (int, float) if kind is float else (kind,)

    def read(raw: Any) -> Any:
        if not isinstance(raw, allowed) or (isinstance(raw, bool) and kind is not bool):
            raise ValueError(f"{raw!r:.40} is not of type `{kind.__name__}`")
        if isinstance(raw, str):
            raw.encode()  # fails on a lone surrogate, which could not be written back
        elif not -_MOST <= raw <= _MOST:  # also refuses NaN
            raise ValueError(f"{raw!r:.40} is out of range")
        return kind(raw)

    return read


def _by_value(kind: type[Enum]) -> Read:
    def read(raw: Any) -> Enum:
        try:
            return kind(raw)
        except ValueError:
            raise ValueError(f"{raw!r:.40} is not a {kind.__name__}") from None

    return read


def _path(raw: Any) -> Path:
    if not isinstance(raw, str) or not raw or "\0" in raw:
        raise ValueError(f"must be a path, not {raw!r:.40}")
    return Path(raw)


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


def _at(place: str | int, read: Read, raw: Any) -> Any:
    try:
        return read(raw)
    except Misfit as error:
        raise Misfit((place, *error.path), error.what) from error
    except ValueError as error:
        raise Misfit((place,), str(error)) from error


def _items(raw: Any) -> Iterable[tuple[Any, Any]]:
    if not isinstance(raw, dict):
        raise ValueError(f"{raw!r:.40} is not a map")  # noqa: TRY004
    return raw.items()


def _class(cls: Any, raw: Any) -> Any:
    entries, reads = _fields(cls)
    found = {n: _at(n, reads[n], value) for n, value in _items(raw) if n in reads}
    for name, one in entries.items():
        if one.required and name not in found:
            raise Misfit((name,), "is missing")
    return cls(**{entries[name].field: value for name, value in found.items()})


@cache  # on first use: a class may contain itself
def _fields(cls: Any) -> tuple[dict[str, keys.Entry], dict[str, Read]]:
    hints = typing.get_type_hints(cls, include_extras=True)
    entries = {one.name: one for one in keys.entries_of(cls)}
    return entries, {n: _of_key(one, _reader(hints[one.field])) for n, one in entries.items()}


def _of_key(entry: keys.Entry, read: Read) -> Read:
    """Return a reader that accepts only what a pool file may say, or the key's default."""
    form, default = entry.key.form, entry.default
    if entry.key is keys.ORDINARY:
        return read

    def checked(raw: Any) -> Any:
        value = read(raw)
        return value if value is None or value == default else keys.checked(form, value)

    return checked
