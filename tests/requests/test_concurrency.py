"""How many requests a service gets at once: what is learned of simulated services."""

from __future__ import annotations

import heapq
import random
from collections import deque

import pytest

from fogft.requests.concurrency import IN_HAND_S, ConcurrencyLimit


def saturated(limit: ConcurrencyLimit, workers: int, median_s: float, sigma: float, answers: int):
    """Keep a service of so many workers at its limit; return answers a second, and its idleness."""
    source = random.Random(3)
    free = [0.0] * workers
    at_work: list[tuple[float, float, int]] = []
    now = 0.0
    for _ in range(answers):
        while len(at_work) < limit.limit:
            worker = min(range(workers), key=free.__getitem__)
            end = max(now, free[worker]) + median_s * source.lognormvariate(0, sigma)
            free[worker] = end
            heapq.heappush(at_work, (end, now, len(at_work) + 1))
        now, began, level = heapq.heappop(at_work)
        limit.finished(level, now - began, now)
    return answers / now


@pytest.mark.parametrize("sigma", [0.0, 0.35])
@pytest.mark.parametrize(("workers", "expected"), [(1, {1}), (2, {2}), (4, {4, 5}), (16, {10})])
def test_it_learns_how_many_a_service_works_on(workers, expected, sigma):
    limit = ConcurrencyLimit(10)
    rate = saturated(limit, workers, 0.05, sigma, 3000)
    assert limit.limit in expected
    mean_s = 0.05 * (1.063 if sigma else 1.0)
    assert rate > 0.93 * min(workers, 10) / mean_s  # what is learned costs no throughput


def test_one_stall_behind_which_all_wait_misleads_no_trial():
    """Else a serial service is taken for a wide one, and has spare copies that wait."""
    limits = []
    for seed in range(10):
        limit, source, at = ConcurrencyLimit(10), random.Random(seed), deque[tuple[float, int]]()
        now = 0.0
        for _ in range(1000):
            while len(at) < limit.limit:
                at.append((now, len(at) + 1))
            now += 0.22 if source.random() < 0.01 else 0.02
            began, level = at.popleft()
            limit.finished(level, now - began, now)
        limits.append(limit.limit)
    assert limits == [1] * 10


def test_a_quick_service_is_not_limited():
    limit = ConcurrencyLimit(10)
    saturated(limit, 1, 0.001, 0.1, 1000)
    assert limit.limit == 10


def test_without_demand_nothing_is_limited():
    limit = ConcurrencyLimit(10)
    for n in range(1000):
        limit.finished(1, 0.5, n * 1.0)
    assert limit.limit == 10


def test_a_given_limit_is_not_learned():
    limit = ConcurrencyLimit(10, given=3)
    saturated(limit, 1, 0.05, 0.0, 500)
    assert limit.limit == 3


def test_a_service_that_gets_more_workers_gets_more_requests():
    limit = ConcurrencyLimit(10)
    saturated(limit, 1, 0.05, 0.1, 500)
    before = limit.limit
    saturated(limit, 8, 0.05, 0.1, 8000)
    assert before == 1
    assert limit.limit >= 8


def test_the_wait_is_what_is_ahead_at_the_pace_so_far():
    limit = ConcurrencyLimit(10, given=2)
    assert limit.wait_s(5, 2) == 0.0  # nothing is known
    limit.finished(2, 0.4, 0.0)
    assert limit.wait_s(4, 2) == pytest.approx(1.0)
    assert limit.wait_s(0, 0) == 0.0


def test_a_limit_is_known_once_it_was_given_or_tried():
    assert ConcurrencyLimit(10, given=3).known == 3
    limit = ConcurrencyLimit(10)
    assert (limit.known, limit.in_hand) == (0, 10)
    saturated(limit, 2, 0.05, 0.0, 3000)
    assert limit.known == limit.limit == 2


@pytest.mark.parametrize(("took_s", "more"), [(IN_HAND_S / 2, 1), (2 * IN_HAND_S, 0)])
def test_one_more_is_in_hand_where_requests_are_short_and_the_limit_is_learned(took_s, more):
    """It fills the moment between two: of long ones nobody would notice it."""
    learned, given = ConcurrencyLimit(10), ConcurrencyLimit(10, given=2)
    for limit in (learned, given):
        saturated(limit, 2, took_s, 0.0, 3000)
    assert (learned.limit, learned.in_hand) == (2, 2 + more)
    assert given.in_hand == 2


def test_what_it_takes_follows_the_answers_and_counts_those_at_work_beside_it():
    limit = ConcurrencyLimit(10, given=4)
    for _ in range(20):
        limit.finished(4, 0.4, 0.0)
    assert (limit.takes_s, limit.service_s) == pytest.approx((0.4, 0.1))
    limit.finished(2, 0.8, 0.0)
    assert (limit.takes_s, limit.service_s) == pytest.approx((0.44, 0.13))
    limit.finished(0, 0.44, 0.0)
    assert limit.takes_s == pytest.approx(0.44), "none at its start counts as one"


def test_a_call_of_seconds_does_not_stand_for_others_and_many_do():
    """It is a first one that loads a model, or a stall. What has become slow is known soon."""
    limit = ConcurrencyLimit(10, given=1)
    for took_s in (5.0, 0.02, 0.02):
        limit.finished(1, took_s, 0.0)
    assert limit.service_s == pytest.approx(0.02)
    for took_s in (*[0.02] * 20, 5.0):
        limit.finished(1, took_s, 0.0)
    assert limit.service_s < 0.04
    for _ in range(30):
        limit.finished(1, 5.0, 0.0)
    assert limit.service_s > 4.0
