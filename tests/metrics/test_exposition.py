"""Prometheus's text format: whatever a label holds, a parser reads it back."""

from __future__ import annotations

import math
import re

from hypothesis import given
from hypothesis import strategies as st

from fogft.metrics.exposition import COUNTER, GAUGE, Sample, histogram, of, text

LINE = re.compile(r'(\w+)(?:\{((?:[^"}]|"(?:[^"\\\n]|\\.)*")*)\})? (\S+)')
LABEL = re.compile(r'(\w+)="((?:[^"\\\n]|\\.)*)"')


def parse(said: str) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """Read the format back, as its description says; comments are left out."""
    found = {}
    assert said == "" or said.endswith("\n")
    for line in said.split("\n")[:-1]:
        if line.startswith("#"):
            continue
        name, labels, value = LINE.fullmatch(line).groups()
        told = tuple(
            (key, re.sub(r"\\(.)", lambda m: {"n": "\n"}.get(m[1], m[1]), raw))
            for key, raw in LABEL.findall(labels or "")
        )
        found[name, told] = float(value)
    return found


@given(label=st.text(st.characters(exclude_categories=["Cs"])), value=st.floats(allow_nan=False))
def test_a_label_and_a_value_come_back(label, value):
    said = text([of("m", GAUGE, "help", [Sample(value, {"service": label})])])
    assert parse(said) == {("m", (("service", label),)): value}


def test_a_lone_surrogate_can_be_sent():
    text([of("m", GAUGE, "help", [Sample(1, {"service": "\ud800"})])]).encode()


@given(counts=st.lists(st.integers(0, 1000), min_size=3, max_size=3))
def test_a_histogram_is_cumulative_and_ends_with_its_count(counts):
    read = parse(text([of("h", "histogram", "", histogram((0.5, 2.0), counts, 9.5, {"s": "x"}))]))
    buckets = [read["h_bucket", (("s", "x"), ("le", le))] for le in ("0.5", "2", "+Inf")]
    assert buckets == [sum(counts[: n + 1]) for n in range(3)]
    assert read["h_count", (("s", "x"),)] == buckets[-1]
    assert read["h_sum", (("s", "x"),)] == 9.5


def test_a_family_has_its_kind_and_help_in_one_line_each():
    said = text([of("m_total", COUNTER, "two\nlines \\ here", [Sample(3)])])
    assert said == "# HELP m_total two\\nlines \\\\ here\n# TYPE m_total counter\nm_total 3\n"


def test_a_family_without_samples_is_left_out():
    assert text([of("m", GAUGE, "nothing", [])]) == ""


def test_numbers_that_are_none_are_told():
    said = text([of("m", GAUGE, "", [Sample(math.nan, {"k": "a"}), Sample(-math.inf, {"k": "b"})])])
    assert said.endswith('m{k="a"} NaN\nm{k="b"} -Inf\n')
