"""Tables that fit: nothing is lost, nothing is cut."""

from __future__ import annotations

import io

from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from fogft.cli.table import table

words = st.text("abcdefgh0123456789.-", min_size=1, max_size=9)
texts = st.lists(words, min_size=1, max_size=8).map(" ".join)


def drawn(made, width: int = 100_000) -> list[str]:
    console = Console(file=io.StringIO(), width=width, color_system=None)
    with console.capture() as captured:
        console.print(made)
    return [line.rstrip() for line in captured.get().splitlines()]


@given(
    rows=st.lists(st.tuples(words, texts, words, words, texts), min_size=1, max_size=5),
    width=st.integers(40, 120),
)
def test_every_word_stands_whole_within_the_width(rows, width):
    """However narrow: a column that does not fit goes below, text is folded between words."""
    names = ("SLOT", "PLACE", "COST", "AGE", "WHY")
    lines = drawn(table(names, rows, width=width, folds=("PLACE", "WHY")))
    assert all(len(line) <= width for line in lines)
    shown = " ".join(lines).split()
    for row in rows:
        for text in row:
            assert set(text.split()) <= set(shown)


@given(rows=st.lists(st.tuples(words, texts, words), min_size=1, max_size=5))
def test_without_a_width_there_is_one_line_for_each_row(rows):
    """A program reads it: nothing is folded, hidden or put below."""
    lines = drawn(table(("A", "B", "C"), rows, folds=("B",), optional=("C",)))
    assert len(lines) == 1 + len(rows)
    for line, row in zip(lines[1:], rows, strict=True):
        assert line.split() == " ".join(row).split()


def test_a_place_is_folded_at_its_slashes():
    rows = [("0", "local/eu-central-1/some-long-zone", "x" * 20)]
    lines = drawn(table(("SLOT", "PLACE", "NOTE"), rows, width=48, folds=("PLACE",)))
    assert lines[1].split() == ["0", "local/eu-central-1/", "x" * 20]
    assert lines[2].split() == ["some-long-zone"]


def test_what_is_optional_goes_where_it_is_empty_everywhere():
    rows = [("a", "0", "-"), ("b", "1", "-")]
    lines = drawn(table(("S", "N", "M"), rows, width=80, optional=("N", "M")))
    assert lines[0].split() == ["S", "N"]
