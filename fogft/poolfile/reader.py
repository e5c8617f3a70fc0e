"""Read a map of keys into the dataclass that describes them. Pure."""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from fogft.errors import SpecError
from fogft.model import keys
from fogft.model.keys import Entry, keys_of
from fogft.poolfile import removed
from fogft.poolfile.tree import Mistakes, Node, Section, plain, shown

T = TypeVar("T")
ADVANCED = "advanced"
Rule = Callable[[Section, Any], Any]


class Reader:
    """Reads maps; a rule checks the resulting dataclass, and may return another."""

    def __init__(self, rules: Mapping[type, Rule], mistakes: Mistakes | None = None) -> None:
        self._rules = rules
        self._mistakes = mistakes or Mistakes()

    def map(self, cls: type[T], section: Section) -> T:
        """Return the dataclass that a map describes."""
        kind: Any = cls  # mypy doubts that `type[T]` is hashable
        entries = keys_of(kind)
        below = [e.name for e in entries if e.key.advanced]
        known = [e.name for e in entries if not e.key.advanced]
        allowed = [*known, ADVANCED] if below else known
        hints, elsewhere = removed.HINTS.get(cls), removed.places(cls)
        values: dict[str, Any] = {}
        with self._mistakes.whole():
            self._mistakes.add(section.unknown(allowed, hints=hints, elsewhere=elsewhere))
            advanced = section.section(ADVANCED if below else "")
            if advanced.children:
                self._mistakes.add(advanced.unknown(below, elsewhere=removed.places(None)))
            for entry in entries:
                is_below = entry.key.advanced and entry.name in advanced.children
                here = advanced if is_below else section
                with self._mistakes.step():
                    if entry.name in here.children:
                        values[entry.field] = self._value(entry, here)
                    elif entry.required:
                        raise here.error(entry.name, "is missing", _hint(entry))
        made = cls(**values)
        rule = self._rules.get(cls)
        return made if rule is None else rule(section, made)

    def _maps(self, form: keys.Maps, section: Section, key: str) -> tuple[Any, ...]:
        found: list[Any] = []
        lines: dict[str, int] = {}
        sections = section.sections(key, form.hint)
        if len(sections) > form.most:
            raise section.error(key, f"has {len(sections)} entries", f"list at most {form.most}")
        for below in sections:
            with self._mistakes.step():
                made: Any = self.map(form.of, below)
                name = getattr(made, "name", None)
                if name in lines:
                    what = f"`{name}` is listed twice (first in line {lines[name]})"
                    raise below.error("name", what, "give each only one entry")
                if name is not None:
                    lines[name] = below.children["name"].line
                found.append(made)
        return tuple(found)

    def _value(self, entry: Entry, section: Section) -> Any:  # noqa: PLR0911
        name, default = entry.name, entry.default
        match entry.key.form:
            case keys.Number() as form:
                return section.number(name, form.most, form.unit, zero=form.from_zero)
            case keys.Whole() as form:
                usual = default if isinstance(default, int) else form.least - 1
                return section.whole(name, usual, form.least, form.most)
            case keys.Flag():
                return section.flag(name, bool(default))
            case keys.OneOf() as form:
                allowed = [m for m in form.of if m not in form.hidden]
                return section.choice(name, allowed, form.hints)
            case keys.Text() as form:
                return _text(form, section, name, section.text(name, form.hint))
            case keys.Listed() as form:
                return _listed(form, section, name)
            case keys.Table() as form:
                return _table(form, section.section(name, form.name.hint))
            case keys.Map() as form:
                return self._map(form, section, name)
            case keys.Maps() as form:
                return self._maps(form, section, name)
            case keys.Free() as form:
                return plain(section.section(name, form.hint).node)
            case keys.Special() as form:
                try:
                    return form.read(plain(section.children[name]))
                except SpecError as error:
                    what = shown(error.message, 300)[1:-1]
                    raise section.error(name, what, error.hint) from None
        raise AssertionError(entry)

    def _map(self, form: keys.Map, section: Section, key: str) -> Any:
        node = section.children[key]
        if form.short and not isinstance(node.value, (Mapping, tuple)) and node.value is not None:
            children = {name: Node(node.value, node.line, node.key_line) for name in form.short}
            meant = Section(section.file, key, Node(children, node.line, node.key_line))
            try:
                return Reader(self._rules).map(form.of, meant)
            except SpecError as error:  # name the key as written, not the one it stands for
                raise section.error(key, error.what, error.hint) from None
        return self.map(form.of, section.section(key, form.hint))


def _text(form: keys.Text, section: Section, key: str, text: str) -> str:
    try:
        return form.check(text)
    except ValueError as error:
        why = f": {error}" if str(error) else ""
        meant = form.suggest(text)
        hint = f"did you mean `{meant}`?" if meant else form.hint
        raise section.error(key, f"{shown(text)} is not {form.what}{why}", hint) from None


def _listed(form: keys.Listed, section: Section, key: str) -> tuple[str, ...]:
    listed = section.children[key].value
    if not isinstance(listed, tuple) or len(listed) < form.least:
        raise section.error(key, "must be a list", form.of.hint)
    found: list[str] = []
    for node in listed:
        if not isinstance(node.value, str):
            what = f"{shown(node.value)} is not {form.of.what}"
            raise section.error(key, what, form.of.hint)
        text = _text(form.of, section, key, node.value)
        if text in found:
            raise section.error(key, f"has `{text}` twice", "list each of them once")
        found.append(text)
    if len(found) > form.most:
        raise section.error(key, f"has {len(found)} entries", f"list at most {form.most}")
    return tuple(found)


def _table(form: keys.Table, section: Section) -> Any:
    for name in section.children:
        try:
            form.name.check(name)
        except ValueError:
            what = f"{shown(name)} is not {form.name.what}"
            raise section.error(name, what, form.name.hint, at_key=True) from None
    unit, zero = form.of.unit, form.of.from_zero
    return {n: section.number(n, form.of.most, unit, zero=zero) for n in section.children}


def _hint(entry: Entry) -> str:
    form = entry.key.form
    if isinstance(form, (keys.Text, keys.Maps, keys.Map, keys.Free)):
        return form.hint
    if isinstance(form, keys.Listed):
        return form.of.hint
    return f"add `{entry.name}`: {keys.words(form)}"
