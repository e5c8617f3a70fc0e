"""The arithmetic of measurements, on samples and distributions whose answer is known."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.estimates import (
    Estimate,
    cumulative,
    estimate,
    estimate_of_rounds,
    longest_gap,
    mean,
    median,
    overhead_ratio,
    p99,
    percentile,
    ratio,
)
from tests.needs import needs

samples = st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=60)


@pytest.mark.parametrize(("percent", "expected"), [(0, 1), (50, 50.5), (99, 99.01), (100, 100)])
def test_percentiles_of_one_to_a_hundred(percent, expected):
    """As numpy's default: linear between neighbours."""
    assert percentile(range(100, 0, -1), percent) == pytest.approx(expected)


@given(samples)
def test_percentiles_rise_and_stay_within_the_sample(values):
    found = [percentile(values, p) for p in (0, 25, 50, 99, 100)]
    assert found == sorted(found)
    assert (found[0], found[-1]) == (min(values), max(values))


@needs("numpy")
@given(samples, st.floats(0, 100))
def test_a_percentile_is_numpys(values, percent):
    import numpy

    expected = numpy.percentile(values, percent)
    assert percentile(values, percent) == pytest.approx(expected, rel=1e-9, abs=1e-6)


def test_the_99th_percentile_of_an_exponential_distribution():
    """It is ln 100 times the mean."""
    source = random.Random(1)
    values = [source.expovariate(0.5) for _ in range(200_000)]
    assert mean(values) == pytest.approx(2.0, rel=0.01)
    assert median(values) == pytest.approx(2.0 * math.log(2), rel=0.02)
    assert p99(values) == pytest.approx(2.0 * math.log(100), rel=0.02)


def test_the_first_of_two_exponential_servers_is_twice_as_fast():
    """Mean and P99 of the smaller of two are half of those of one."""
    source = random.Random(2)
    one = [source.expovariate(1.0) for _ in range(5_000)]
    two = [min(source.expovariate(1.0), source.expovariate(1.0)) for _ in range(5_000)]
    for statistic in (mean, p99):
        found = ratio(one, two, statistic, resamples=200)
        assert found.low < 2.0 < found.high
        assert found.value == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("statistic", [mean, median])
def test_an_interval_holds_the_truth_about_as_often_as_promised(statistic):
    """In 95 % of experiments; here in at least 87 of 100."""
    held = 0
    for seed in range(100):
        source = random.Random(seed)
        values = [source.gauss(10.0, 2.0) for _ in range(80)]
        found = estimate(values, statistic, seed=seed, resamples=300)
        assert found.low <= found.value <= found.high
        held += found.low <= 10.0 <= found.high
    assert held >= 87


def test_the_interval_of_a_ratio_holds_the_truth_about_as_often_as_promised():
    """Two exponential servers whose means are as 3 to 2."""
    held = 0
    for seed in range(100):
        source = random.Random(seed)
        slow = [source.expovariate(1 / 3) for _ in range(100)]
        fast = [source.expovariate(1 / 2) for _ in range(100)]
        found = ratio(slow, fast, mean, seed=seed, resamples=300)
        held += found.low <= 1.5 <= found.high
    assert held >= 87


def test_equal_samples_have_a_ratio_of_one_and_its_interval_holds_it():
    values = [random.Random(3).expovariate(1.0) for _ in range(100)]
    found = ratio(values, values, p99)
    assert found.value == 1.0
    assert found.low <= 1.0 <= found.high


def test_the_same_seed_gives_the_same_interval():
    values = [random.Random(4).random() for _ in range(50)]
    assert estimate(values, mean, seed=7) == estimate(values, mean, seed=7)


@given(samples)
def test_a_cumulative_distribution_rises_to_one(values):
    """At each value: the fraction that is not above it (the last of equal values has it)."""
    places, fractions = cumulative(values)
    assert places == sorted(values)
    assert fractions[-1] == 1.0
    for place, fraction in dict(zip(places, fractions, strict=True)).items():
        assert fraction == pytest.approx(sum(v <= place for v in values) / len(values))


@pytest.mark.parametrize("wrong", [mean, p99, lambda v: estimate(v, mean)])
def test_nothing_has_no_statistic(wrong):
    with pytest.raises(ValueError, match="no"):
        wrong([])


def test_an_estimate_shows_its_interval():
    assert str(Estimate(1.23456, 0.99, 1500.4)) == "1.23 [0.99, 1500]"
    assert str(estimate([2.0, 2.0], mean)) == "2"


@pytest.mark.parametrize(("sample", "expected"), [([3, 1, 2], 2), ([4, 1, 2, 3], 2.5), ([7], 7)])
def test_median(sample, expected):
    assert median(sample) == expected


def test_the_best_ratio_is_one():
    """A proxied call that adds one direct call and one round trip has ratio 1."""
    assert overhead_ratio(direct=2.0, proxied=2.0 + 2.0 + 0.5, round_trip=0.5) == 1.0


def test_the_interval_of_a_median_holds_it_about_as_often_as_promised():
    """In 95 % of experiments the interval holds the true median; here in 85 to 100 of 100."""
    held = 0
    for seed in range(100):
        source = random.Random(seed)
        sample = [source.gauss(10.0, 2.0) for _ in range(60)]
        found = estimate_of_rounds({"x": sample}, lambda s: median(s["x"]), source, resamples=200)
        assert found.low <= found.value <= found.high
        held += found.low <= 10.0 <= found.high
    assert held >= 85


def test_what_all_sides_of_a_round_suffer_stays_together():
    """The difference of two sides that drift together is certain, however much they drift."""
    drift = [float(i % 17) for i in range(200)]
    sides = {"a": drift, "b": [d + 3.0 for d in drift]}
    found = estimate_of_rounds(
        sides, lambda s: sum(s["b"]) - sum(s["a"]), random.Random(1), resamples=50
    )
    assert found.low == found.high == found.value == 600.0


def test_sides_of_different_length_are_refused():
    with pytest.raises(ValueError, match="one length"):
        estimate_of_rounds({"a": [1.0], "b": [1.0, 2.0]}, lambda s: 0.0, random.Random(0))


@pytest.mark.parametrize(("moments", "expected"), [([], 0.0), ([5.0], 0.0), ([1.0, 4.0, 2.0], 2.0)])
def test_longest_gap(moments, expected):
    assert longest_gap(moments) == expected
