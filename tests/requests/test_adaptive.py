"""Estimates, the budget, and whom adaptive hedging asks when."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.requests.adaptive import BUDGET_CAPACITY, Adaptive, TokenBucket
from fogft.requests.latency import Latencies

A = b"a" * 16


@given(st.lists(st.booleans(), max_size=300), st.floats(0.01, 1.0), st.floats(0, 20))
def test_the_budget_is_never_exceeded(takes, share, capacity):
    """After n requests at most capacity + share * n tokens were taken."""
    bucket = TokenBucket(share, capacity)
    taken = 0
    for n, take in enumerate(takes, start=1):
        bucket.request()
        taken += take and bucket.take()
        assert taken <= capacity + share * n + 1e-6


@given(st.lists(st.floats(0.0002, 1000), min_size=1, max_size=200), st.floats(0.5, 0.99))
def test_a_quantile_is_right_to_a_bucket(values, share):
    """Without decay it lies at the sample's own quantile, to within 10 %."""
    found = Latencies(half_life=1e9)
    for value in values:
        found.add(value, 0.0)
    ordered = sorted(values)
    quantile = found.quantile_s(share)
    assert quantile is not None
    below = ordered[max(0, int(share * len(values) - 1e-9) - 1)]
    above = ordered[min(len(values) - 1, int(share * len(values) + 1e-9))]
    assert below / 1.11 <= quantile <= above * 1.11


def test_old_latencies_fade_with_samples_and_with_time():
    by_samples, by_time = Latencies(half_life=20), Latencies(half_life_s=10)
    for n in range(100):
        by_samples.add(1.0, 0.0)
        by_time.add(1.0, n / 100)
    for _ in range(100):
        by_samples.add(0.1, 0.0)
    for n in range(5):
        by_time.add(0.1, 100.0 + n)
    for found in (by_samples, by_time):
        median = found.quantile_s(0.5)
        assert median == pytest.approx(0.1, rel=0.11)


def test_weights_do_not_overflow():
    found = Latencies(half_life=1, half_life_s=0.1)
    for n in range(5000):
        found.add(0.2, n * 60.0)
    assert found.quantile_s(0.95) == pytest.approx(0.2, rel=0.11)
    assert found.mean_below_s(0.95) == pytest.approx(0.2, rel=0.2)


def learned(**medians_s: float) -> Adaptive:
    """Return a policy that knows replicas by their latency: ``r1=0.1`` is replica 1."""
    policy = Adaptive()
    for name, median_s in medians_s.items():
        replica = int(name[1:])
        for n in range(30):
            policy.first(A, (replica,), n * 1.0)
            policy.answered(A, {replica: n * 1.0}, replica, n + median_s)
    return policy


def test_the_best_by_measured_latency_is_asked():
    policy = learned(r1=0.3, r2=0.1, r3=0.2)
    assert policy.first(A, (1, 2, 3), 31.0) == [2]


def test_the_next_is_asked_after_the_learned_delay_and_not_before():
    policy = learned(r1=0.1, r2=0.2)
    policy.first(A, (1, 2), 31.0)
    assert 31.09 < policy.look_at < 31.12
    assert policy.more({1: 31.0}, (2,), 31.05) == ()
    assert policy.more({1: 31.0}, (2,), 31.12) == (2,)


def test_when_nobody_works_on_a_request_the_next_is_asked_at_once_without_a_token():
    """The first was suspect, or refused it: a copy is replaced, not added."""
    policy = learned(r1=0.1, r2=0.2)
    policy.first(A, (1, 2), 31.0)
    policy.failed(A, 1, 31.001)
    before = policy.report()["tokens"]
    assert policy.more({}, (2,), 31.001) == (2,)
    assert policy.report()["tokens"] == before


def test_a_replica_that_does_not_answer_is_avoided_before_it_is_suspected():
    """Frozen: its probes go unanswered for two seconds, in which it must not get all requests."""
    policy = learned(r1=0.1, r2=0.2)
    policy.first(A, (1, 2), 31.0)
    policy.more({1: 31.0}, (2,), 31.2)
    assert policy.first(A, (1, 2), 31.3)[0] == 2


def test_an_answer_ends_the_doubt():
    policy = learned(r1=0.1, r2=0.2)
    policy.first(A, (1, 2), 31.0)
    policy.more({1: 31.0}, (2,), 31.2)
    policy.answered(A, {1: 31.0, 2: 31.2}, 1, 31.25)
    assert policy.first(A, (1, 2), 31.3)[0] == 1


def test_a_slow_answer_of_one_request_is_no_doubt_while_others_are_answered():
    """One request in a hundred may stall; the replica is well."""
    policy = learned(r1=0.1, r2=0.2)
    policy.first(A, (1, 2), 31.0)
    policy.first(b"b" * 16, (1, 2), 31.1)
    policy.answered(b"b" * 16, {1: 31.1}, 1, 31.15)
    policy.more({1: 31.0}, (2,), 31.2)
    assert policy.first(A, (1, 2), 31.3)[0] == 1


def test_an_unused_replica_gets_a_probing_copy_that_is_awaited():
    policy = learned(r1=0.1, r2=0.2)
    later = 60.0
    assert policy.first(A, (1, 2), later) == [1, 2]
    assert list(policy.answered(A, {1: later, 2: later}, 1, later + 0.1)) == []
    assert policy.awaits(A, 2)
    policy.late(A, 2, later + 0.01, answered=True)
    assert not policy.awaits(A, 2)
    assert policy.first(A, (1, 2), later + 1.0) == [1]


def test_probing_copies_leave_half_of_the_budget_to_hedges():
    policy = Adaptive(budget=0.01, probe_every_s=0.5)
    for n in range(20):
        policy.first(bytes([n]) * 16, (1, 2, 3), n * 1.0)
    assert policy.report()["tokens"] >= BUDGET_CAPACITY / 2


def test_a_replica_that_got_better_is_found():
    """Its estimate never goes stale, though it is not the best."""
    source = random.Random(1)
    policy = learned(r1=0.1, r2=1.0)
    chosen = []
    for n in range(3000):
        now, request = 31.0 + n * 0.2, n.to_bytes(16, "big")
        asked = policy.first(request, (1, 2), now)
        took = {1: 0.1 * source.uniform(0.9, 1.1), 2: 0.02}
        winner = min(asked, key=lambda replica: took[replica])
        policy.answered(request, dict.fromkeys(asked, now), winner, now + took[winner])
        for replica in asked:
            if policy.awaits(request, replica):
                policy.late(request, replica, now + took[replica], answered=True)
        chosen.append(asked[0])
    assert chosen[0] == 1
    assert chosen[-1] == 2


def test_a_full_window_turns_it_to_another():
    policy = learned(r1=0.1, r2=0.2)
    (first, *_) = policy.first(A, (1, 2), 31.0)
    policy.declined(first, full=True)
    assert policy.more({}, (1, 2), 31.0) == (2,)


def test_with_more_open_than_usual_the_next_best_is_taken():
    """A burst does not queue at one replica while another is idle."""
    policy = learned(r1=0.1, r2=0.15)
    chosen = [policy.first(bytes([n]) * 16, (1, 2), 31.0)[0] for n in range(6)]
    assert set(chosen) == {1, 2}
