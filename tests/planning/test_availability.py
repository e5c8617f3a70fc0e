"""Unequal and correlated replicas: laws of the model, the paper's figures, real traces."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fogft.model.replica import Placement
from fogft.planning.availability import (
    Assumption,
    Correlation,
    expected,
    full_together,
    joint_unavailability,
)

A = Placement("aws", "us-west-1", "a", "m1")
ZONE = replace(A, instance="m2")
REGION = replace(A, zone="b")
CLOUD = replace(A, region="us-west-2")
OTHER = replace(A, cloud="gcp")
INDEPENDENT = Correlation(0.0, 0.0, 0.0)

placements = st.builds(
    Placement,
    st.sampled_from(["c1", "c2"]),
    st.sampled_from(["r1", "r2"]),
    st.sampled_from(["a", "b"]),
    st.just("m1"),
)
fractions = st.floats(0, 1)
replicas = st.lists(st.tuples(placements, fractions), min_size=1, max_size=6)
correlations = st.lists(fractions, min_size=3, max_size=3).map(
    lambda three: Correlation(*sorted(three, reverse=True))
)


def test_the_papers_figures():
    """15 h up and 20 min away: 2.17 % for one VM, 0.047 % for two that are independent."""
    assumed = Assumption(correlation=INDEPENDENT)
    assert 1 - expected([A], assumed).correlated == pytest.approx(0.0217, abs=5e-5)
    assert 1 - expected([A, CLOUD], assumed).correlated == pytest.approx(0.00047, abs=5e-6)
    assert 1 - expected([replace(A, spot=False)], assumed).correlated == pytest.approx(1e-4, 0.01)


def test_two_zones_of_the_public_traces():
    """Nine zones, each up 65.4 % of the time (so two independent ones 88.0 %): with the measured
    correlations of 0.43 in a region and 0.14 across, 0.22 over all pairs, the model says 83 %; the
    traces say 84.1 %."""
    down = math.sqrt(1 - 0.880)
    near, far = (
        joint_unavailability([(A, down), (other, down)], Correlation()) for other in (REGION, CLOUD)
    )
    share = (0.22 - 0.14) / (0.43 - 0.14)  # of the pairs that lie in one region
    both = share * near + (1 - share) * far
    assert 1 - both == pytest.approx(0.841, abs=0.012)
    assert 1 - both < 0.841 < 0.880


@pytest.mark.parametrize(
    ("other", "level"), [(ZONE, "zone"), (REGION, "region"), (CLOUD, "cloud"), (OTHER, "")]
)
@given(correlation=correlations, down=st.floats(0.001, 0.999))
def test_a_pairs_correlation_is_the_one_asked_for(other, level, correlation, down):
    """Two equal replicas: P(both) = q^2 + r q (1 - q), with r of the closest level they share."""
    both = joint_unavailability([(A, down), (other, down)], correlation)
    r = getattr(correlation, level) if level else 0.0
    assert both == pytest.approx(down**2 + r * down * (1 - down), abs=1e-9)


@given(one=st.tuples(placements, fractions), correlation=correlations)
def test_a_lone_replica_is_down_as_often_as_it_is(one, correlation):
    assert joint_unavailability([one], correlation) == pytest.approx(one[1], abs=1e-9)


@given(pool=replicas)
def test_without_correlation_it_is_the_product(pool):
    product = math.prod(down for _, down in pool)
    assert joint_unavailability(pool, INDEPENDENT) == pytest.approx(product, abs=1e-9)


@given(pool=replicas, correlation=correlations)
def test_independence_is_the_best_case_and_the_best_replica_the_worst(pool, correlation):
    """Correlation never helps, and a pool is never worse than its best replica."""
    both = joint_unavailability(pool, correlation)
    assert both >= math.prod(down for _, down in pool) - 1e-9
    assert both <= min(down for _, down in pool) + 1e-9


@given(pool=replicas, another=st.tuples(placements, fractions), correlation=correlations)
def test_another_replica_never_hurts(pool, another, correlation):
    more = joint_unavailability([*pool, another], correlation)
    assert more <= joint_unavailability(pool, correlation) + 1e-9


@given(pool=replicas, correlation=correlations, seed=st.randoms())
def test_order_does_not_matter(pool, correlation, seed):
    shuffled = list(pool)
    seed.shuffle(shuffled)
    assert joint_unavailability(shuffled, correlation) == pytest.approx(
        joint_unavailability(pool, correlation), abs=1e-12
    )


@given(pool=replicas, correlation=correlations)
def test_moving_to_another_cloud_never_hurts(pool, correlation):
    """The same replica in a cloud of its own is down together with the others less often."""
    (place, down), *others = pool
    apart = [(replace(place, cloud="c9"), down), *others]
    assert (
        joint_unavailability(apart, correlation) <= joint_unavailability(pool, correlation) + 1e-9
    )


def test_while_no_location_has_room_no_spot_machine_is_up():
    """Six replicas reach no more than the time in which one location has room; others do."""
    assumed = Assumption(no_room=0.355)  # of the nine zones above
    three = [replace(A, zone=zone) for zone in "abc"]
    full = 1 - expected([A], assumed, three).correlated
    at_once = replace(assumed, recovery_s=0.0)
    assert full_together(three, at_once) == pytest.approx(0.17, abs=0.01)  # simulated: 0.172
    assert 1 - expected(three * 2, assumed, three).correlated > 0.16
    on_demand = [*three, replace(A, spot=False)]
    assert 1 - expected(on_demand, assumed, three).correlated < 1e-3 < full
    assert expected(three, assumed) == expected(three, replace(assumed, no_room=0.0), three)


@given(places=st.lists(placements, min_size=1, max_size=6), another=placements, share=fractions)
@example(places=[A], another=A, share=1.0 - 2**-53)  # two such are 1 by their rounding
def test_another_location_never_hurts(places, another, share):
    assumed = Assumption(no_room=share)
    assert full_together([*places, another], assumed) <= full_together(places, assumed) + 1e-9


def test_no_replica_never_answers():
    assert joint_unavailability([], Correlation()) == 1.0
    assert expected([], Assumption()).correlated == 0.0
