"""The bench's arithmetic, on samples whose answer is known."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.bench.statistics import (
    estimate,
    longest_gap,
    median,
    overhead_ratio,
    percentile,
)

values = st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=50)


@pytest.mark.parametrize(
    ("percent", "expected"), [(1, 1), (50, 50), (99, 99), (99.1, 100), (100, 100)]
)
def test_percentiles_of_one_to_a_hundred(percent, expected):
    assert percentile(list(range(100, 0, -1)), percent) == expected


@given(values, st.floats(0.1, 100))
def test_a_percentile_is_a_value_that_enough_do_not_exceed(sample, percent):
    """At least that share lies at or below it, and less than that share below it."""
    found = percentile(sample, percent)
    assert found in sample
    assert sum(v <= found for v in sample) * 100 >= percent * len(sample) - 1e-6
    assert sum(v < found for v in sample) * 100 < percent * len(sample) + 1e-6


@pytest.mark.parametrize(("sample", "expected"), [([3, 1, 2], 2), ([4, 1, 2, 3], 2.5), ([7], 7)])
def test_median(sample, expected):
    assert median(sample) == expected


@pytest.mark.parametrize("wrong", [lambda: median([]), lambda: percentile([], 50)])
def test_nothing_has_no_median(wrong):
    with pytest.raises(ValueError, match="no"):
        wrong()


def test_the_best_ratio_is_one():
    """A proxied call that adds one direct call and one round trip has ratio 1."""
    assert overhead_ratio(direct=2.0, proxied=2.0 + 2.0 + 0.5, round_trip=0.5) == 1.0


def test_the_interval_of_a_median_holds_it_about_as_often_as_promised():
    """In 95 % of experiments the interval holds the true median; here in 85 to 100 of 100."""
    held = 0
    for seed in range(100):
        source = random.Random(seed)
        sample = [source.gauss(10.0, 2.0) for _ in range(60)]
        found = estimate({"x": sample}, lambda s: median(s["x"]), source, resamples=200)
        assert found.low <= found.value <= found.high
        held += found.low <= 10.0 <= found.high
    assert held >= 85


def test_what_all_sides_of_a_round_suffer_stays_together():
    """The difference of two sides that drift together is certain, however much they drift."""
    drift = [float(i % 17) for i in range(200)]
    sides = {"a": drift, "b": [d + 3.0 for d in drift]}
    found = estimate(sides, lambda s: sum(s["b"]) - sum(s["a"]), random.Random(1), resamples=50)
    assert found.low == found.high == found.value == 600.0


def test_sides_of_different_length_are_refused():
    with pytest.raises(ValueError, match="one length"):
        estimate({"a": [1.0], "b": [1.0, 2.0]}, lambda s: 0.0, random.Random(0))


@pytest.mark.parametrize(("moments", "expected"), [([], 0.0), ([5.0], 0.0), ([1.0, 4.0, 2.0], 2.0)])
def test_longest_gap(moments, expected):
    assert longest_gap(moments) == expected
