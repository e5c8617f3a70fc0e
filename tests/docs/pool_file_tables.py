"""The tables in docs/reference/pool-file.md, made from the one table of keys."""

from __future__ import annotations

from collections.abc import Iterator

from fogft.model import keys
from fogft.model.keys import Entry, keys_of, words
from fogft.model.spec import PoolSpec
from fogft.poolfile.reader import ADVANCED


def tables() -> Iterator[str]:
    """Yield a table for each map, the pool's own first."""
    yield from _tables("`fogft`", PoolSpec, set())


def _tables(title: str, cls: type, seen: set[type]) -> Iterator[str]:
    seen.add(cls)
    entries = keys_of(cls)
    usual = [entry for entry in entries if not entry.key.advanced]
    advanced = [entry for entry in entries if entry.key.advanced]
    yield from _table(f"### {title}", usual)
    if advanced:
        yield from _table(f"### `{ADVANCED}` of {title[0].lower()}{title[1:]}", advanced)
    for entry in entries:
        form = entry.key.form
        if isinstance(form, (keys.Map, keys.Maps)) and form.of not in seen and keys_of(form.of):
            each = "Each of " if isinstance(form, keys.Maps) else ""
            yield from _tables(f"{each}`{entry.name}`", form.of, seen)


def _table(title: str, entries: list[Entry]) -> Iterator[str]:
    yield f"{title}\n"
    yield "| key | type | default | meaning |"
    yield "|---|---|---|---|"
    for entry in entries:
        cells = (f"`{entry.name}`", words(entry.key.form), _default(entry), entry.key.help)
        yield f"| {' | '.join(cells)} |"
    yield ""


def _default(entry: Entry) -> str:
    if entry.key.usual:
        return entry.key.usual
    if entry.required:
        return "required"
    if entry.default in (None, "", (), {}):
        return "none"
    value = getattr(entry.default, "value", entry.default)
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, (int, float)):
        return f"{value:.10g}"
    return f"`{value}`" if isinstance(value, str) else "see below"
