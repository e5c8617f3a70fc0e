"""A pool file as a tree that remembers its lines, and typed access to it.

Every error is one `SpecError` that begins with ``file:line: key:`` and is one line long,
whatever the file contains; its hint says how to correct it.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import Enum
from typing import Any, NamedTuple

from fogft.errors import SpecError

SMALLEST = 1e-12  # of a number above 0: a smaller one is a typing mistake


class Node(NamedTuple):
    """A value with its line, and the line of the key that it belongs to."""

    value: str | int | float | bool | tuple[Node, ...] | Mapping[str, Node] | None
    line: int
    key_line: int


def plain(node: Node) -> Any:
    """Return the value without lines, as fresh lists and dictionaries."""
    if isinstance(node.value, Mapping):
        return {key: plain(child) for key, child in node.value.items()}
    if isinstance(node.value, tuple):
        return [plain(child) for child in node.value]
    return node.value


def below(node: Node, path: Iterable[str | int]) -> Node:
    """Return the node at a path of keys and indices, or the deepest one that exists."""
    for part in path:
        value: Any = node.value
        known = dict(enumerate(value)) if isinstance(value, tuple) else value
        if not isinstance(known, Mapping) or part not in known:
            break
        node = known[part]
    return node


def tree(value: Any, line: int = 1) -> Node:
    """Return plain lists and dictionaries as a tree, all on one line; the inverse of `plain`."""
    if isinstance(value, Mapping):
        below: Any = {str(key): tree(child, line) for key, child in value.items()}
    elif isinstance(value, (list, tuple)):
        below = tuple(tree(child, line) for child in value)
    else:
        below = value
    return Node(below, line, line)


def shown(value: object, limit: int = 60) -> str:
    """Return text in backquotes that is safe to print: one line, no control characters."""
    text = str(value)
    text = text if len(text) <= limit else text[: limit - 3] + "..."
    return "`" + "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text) + "`"


def nearest(word: str, known: Iterable[str]) -> str:
    """Return the hint for an unknown word."""
    words = sorted(known)
    close = difflib.get_close_matches(word[:60], words, n=1)
    if close:
        return f"did you mean `{close[0]}`?"
    return "known here: " + ", ".join(f"`{w}`" for w in words)


class Section:
    """A map in a pool file, read key by key."""

    def __init__(self, file: str, path: str, node: Node, hint: str = "") -> None:
        if not isinstance(node.value, Mapping):
            raise SpecError(
                f"{file}:{node.line}: {path or 'file'}: must be a map of keys, not {_got(node)}",
                hint or "write `key: value` lines here",
            )
        self.file = file
        self.path = path
        self.node = node
        self.children: Mapping[str, Node] = node.value

    def error(self, key: str, what: str, hint: str = "", *, at_key: bool = False) -> SpecError:
        """Return the error about a key of this section, with the best known line."""
        if key not in self.children and self.has(key):
            return self.section("advanced").error(key, what, hint, at_key=at_key)
        node = self.children.get(key)
        line = self.node.key_line if node is None else node.key_line if at_key else node.line
        word = key if key and key == key.strip() else f'"{key}"'
        full = f"{self.path}.{word}" if self.path else word
        message = f"{self.file}:{line}: {shown(full, 80)[1:-1]}: {what}"
        return SpecError(message, hint, key=full, what=what, line=line)

    def only(self, known: Iterable[str]) -> None:
        """Refuse every key that is not known."""
        for error in self.unknown(known):
            raise error

    def unknown(
        self,
        known: Iterable[str],
        *,
        hints: Mapping[str, tuple[str, str]] | None = None,
        elsewhere: Mapping[str, str] | None = None,
    ) -> Iterator[SpecError]:
        """Yield an error for each unknown key; `hints` are for those of other versions."""
        allowed = set(known)
        for key in [key for key in self.children if key not in allowed]:
            what, hint = "unknown key", nearest(key, allowed)
            if hints and key in hints:
                what, hint = hints[key]
            elif elsewhere and key in elsewhere:
                hint = f"`{key}` belongs {elsewhere[key]}"
            yield self.error(key, what, hint, at_key=True)

    def has(self, key: str) -> bool:
        """Whether the key has a value, here or under `advanced`, which no SkyPilot task has."""
        if key in self.children:
            return self.children[key].value is not None
        is_ours = self.path and "advanced" in self.children
        below = self.children["advanced"].value if is_ours else None
        return isinstance(below, Mapping) and key in below and below[key].value is not None

    def text(self, key: str, hint: str) -> str:
        """Return a text that is not blank."""
        if key not in self.children:
            raise self.error(key, "is missing", hint)
        node = self.children[key]
        if not isinstance(node.value, str):
            quoted = "; put it in quotes" if isinstance(node.value, (bool, int, float)) else ""
            raise self.error(key, f"must be text, not {_got(node)}", hint + quoted)
        if not node.value.strip():
            raise self.error(key, "is empty", hint)
        return node.value

    def whole(self, key: str, default: int, low: int, high: int) -> int:
        """Return a whole number from `low` to `high`."""
        if key not in self.children:
            return default
        node = self.children[key]
        hint = f"write a whole number from {low} to {high}"
        hint += f"; the default is {default}" if low <= default <= high else ""
        if isinstance(node.value, bool) or not isinstance(node.value, int):
            raise self.error(key, f"must be a whole number, not {_got(node)}", hint)
        if not low <= node.value <= high:
            raise self.error(key, f"must be from {low} to {high}, not {shown(node.value)}", hint)
        return node.value

    def flag(self, key: str, default: bool) -> bool:
        """Return a boolean."""
        if key not in self.children:
            return default
        node = self.children[key]
        if not isinstance(node.value, bool):
            hint = f"write `{key}: true` or `{key}: false`"
            raise self.error(key, f"must be true or false, not {_got(node)}", hint)
        return node.value

    def number(
        self, key: str, high: float, unit: str, default: float | None = None, *, zero: bool = False
    ) -> float:
        """Return a number above 0 (with `zero`: or 0) and at most `high`."""
        if key not in self.children and default is not None:
            return default
        node = self.children[key]
        limits = f"{'from' if zero else 'above'} 0 {'to' if zero else 'and at most'} {high:g}"
        what = f"number of {unit}" if unit else "fraction"
        hint = f"write a {what} {limits}, such as `{key}: {min(2.5, high):g}`"
        if isinstance(node.value, bool) or not isinstance(node.value, (int, float)):
            raise self.error(key, f"must be a number, not {_got(node)}", hint)
        if not math.isfinite(node.value):
            raise self.error(key, f"must be finite, not {shown(node.value)}", hint)
        if 0 < node.value < SMALLEST:
            raise self.error(key, f"is too small: {shown(node.value)}", hint)
        if not 0 <= node.value <= high or not (node.value or zero):
            raise self.error(key, f"must be {limits}, not {shown(node.value)}", hint)
        return float(node.value)

    def choice(self, key: str, members: Sequence[Enum], hints: Mapping[str, str]) -> Enum:
        """Return one of the given members of an enumeration; `hints` are by value."""
        by_value = {str(member.value): member for member in members}
        allowed = " or ".join(f"`{value}`" for value in by_value)
        text = self.text(key, f"write {allowed}")
        if text not in by_value:
            hint = hints.get(text) or nearest(text, by_value)
            raise self.error(key, f"must be {allowed}, not {shown(text)}", hint)
        return by_value[text]

    def section(self, key: str, hint: str = "") -> Section:
        """Return the map at a key; an empty one if the key is absent."""
        node = self.children.get(key) or Node({}, self.node.line, self.node.key_line)
        return Section(self.file, f"{self.path}.{key}" if self.path else key, node, hint)

    def sections(self, key: str, hint: str) -> Sequence[Section]:
        """Return the list of maps at a key, which must exist and not be empty."""
        if key not in self.children:
            raise self.error(key, "is missing", hint)
        node = self.children[key]
        if not isinstance(node.value, tuple):
            raise self.error(key, f"must be a list, not {_got(node)}", hint)
        if not node.value:
            raise self.error(key, "is empty", hint)
        path = f"{self.path}.{key}" if self.path else key
        return [
            Section(self.file, f"{path}[{index}]", child, hint)
            for index, child in enumerate(node.value)
        ]


def _got(node: Node) -> str:
    value = node.value
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return f"the boolean `{str(value).lower()}`"
    if isinstance(value, (int, float)):
        return f"the number {shown(value)}"
    if isinstance(value, str):
        return f"the text {shown(value)}"
    return "a list" if isinstance(value, tuple) else "a map"


class Incomplete(Exception):
    """A value is incomplete because of mistakes in it."""


class Mistakes:
    """The mistakes in a file; with `keep`, reading continues after each."""

    def __init__(self, *, keep: bool = False) -> None:
        self._keep = keep
        self.found: list[SpecError] = []

    @contextmanager
    def step(self) -> Iterator[None]:
        """Run a check that does not depend on others."""
        try:
            yield
        except SpecError as error:
            if not self._keep:
                raise
            self.found.append(error)
        except Incomplete:
            pass

    def add(self, errors: Iterable[SpecError]) -> None:
        """Add mistakes: the first is raised unless all are kept."""
        for error in errors:
            with self.step():
                raise error

    @contextmanager
    def whole(self) -> Iterator[None]:
        """Check all parts of one value. Raises Incomplete if a mistake was found in one."""
        before = len(self.found)
        yield
        if len(self.found) > before:
            raise Incomplete
