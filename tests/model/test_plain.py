"""Reading JSON data as classes, by several threads at once."""

from __future__ import annotations

from dataclasses import make_dataclass

from fogft.model.plain import from_plain
from tests.fakes.threads import at_once


def test_threads_that_read_the_first_of_a_class_at_once_all_read_it() -> None:
    """As links do that are answered their first probes together."""
    for _ in range(100):
        inner = make_dataclass("Inner", [("parts", tuple[str, ...])])
        outer = make_dataclass("Outer", [("of", inner)])
        right = outer(inner(("it",)))

        def read(outer: type = outer, right: object = right) -> None:
            assert from_plain(outer, {"of": {"parts": ["it"]}}) == right

        at_once(read, read, read, read)
