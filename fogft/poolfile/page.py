"""The reference in docs/pool-file.md, made from the table of keys.

``python -m fogft.poolfile.page <docs/pool-file.md`` prints the page brought up to date.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

from fogft.model import keys
from fogft.model.keys import Entry, keys_of, words
from fogft.model.spec import PoolSpec
from fogft.poolfile.reader import ADVANCED

BEGIN, END = "<!-- made by `python -m fogft.poolfile.page` -->", "<!-- end of what is made -->"


def reference() -> str:
    """Return a table for each map, the pool's own first."""
    return "\n".join(_tables("`fogft`", PoolSpec, set())) + "\n"


def _tables(title: str, cls: type, seen: set[type]) -> Iterator[str]:
    seen.add(cls)
    entries = keys_of(cls)
    usual = [entry for entry in entries if not entry.key.advanced]
    advanced = [entry for entry in entries if entry.key.advanced]
    yield from _table(f"### {title}", usual)
    if advanced:
        yield from _table(f"### `{ADVANCED}` of {title}", advanced)
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


def brought_up_to_date(page: str) -> str:
    """Return the page with the reference between its two marks made anew."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n\n{reference()}\n{END}{after}"


if __name__ == "__main__":
    sys.stdout.write(brought_up_to_date(sys.stdin.read()))
