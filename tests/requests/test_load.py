"""What one robot knows of a replica's load, and how often a service is asked."""

from __future__ import annotations

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fogft.requests.latency import Latencies
from fogft.requests.load import (
    NEARLY,
    NEVER,
    SHORTEST_DELAY_S,
    UNKNOWN_DELAY_S,
    Demand,
    Load,
    ReplicaLoad,
)

A, B, C = b"a" * 16, b"b" * 16, b"c" * 16


def says(
    waiting: int = 0, running: int = 0, slots: int = 0, service_s: float = 0.1, spent_s: float = 0.1
) -> Load:
    return Load(waiting, running, slots, service_s, spent_s)


def known(
    took_s: float = 0.1, *, count: int = 10, service_s: float = 0.1, slots: int = 0
) -> ReplicaLoad:
    """Return what is known of one that has answered so many, the last one before second 10."""
    found = ReplicaLoad()
    for number in range(count):
        at = 10.0 - count + number
        found.asked(A, at)
        load = says(slots=slots, service_s=service_s, spent_s=min(took_s, service_s))
        found.heard(A, load, at + took_s)
        found.answered(A, load, at + took_s)
    return found


# -- how many replicas are needed ---------------------------------------------------------------


def crowded(seconds: float, *, answered: float = 1.0, waiting: int = 1) -> Demand:
    """Return what a robot has seen that asks ten a second, of which that share is answered."""
    demand, owed = Demand(), 0.0
    for number in range(round(10 * seconds)):
        demand.asked(number / 10)
        owed += answered
        if owed >= 1.0:
            demand.answered(says(waiting=waiting), number / 10)
            owed -= 1.0
    return demand


@pytest.mark.parametrize(
    ("answered", "able", "needed"),
    [(1.0, 3, 0), (0.9, 3, 0), (0.8, 1, 2), (2 / 3, 3, 6), (1 / 3, 3, 12)],
)
def test_full_replicas_are_too_few_by_what_they_leave_unanswered(answered, able, needed):
    """Asked for is what leaves a fifth free, whoever else asks."""
    assert crowded(60.0, answered=answered).replicas(able, 0.0, 60.0) == needed


def test_where_nobody_answers_any_more_what_it_has_said_does_not_grow():
    demand = crowded(60.0, answered=2 / 3)
    for number in range(600, 1800):
        demand.asked(number / 10)
        assert demand.replicas(3, 0.0, number / 10) in ((6, 7) if number < 640 else (0, 6, 7))
    assert demand.replicas(3, 0.0, 180.0) == 0


def test_where_nothing_waits_there_are_enough_whatever_is_not_answered():
    """It is lost to faults."""
    assert crowded(60.0, answered=0.1, waiting=0).replicas(1, 0.0, 60.0) == 0
    assert Demand().replicas(0, 0.0, 0.0) == 0


def test_a_burst_is_no_reason_and_a_crowd_is_forgotten_within_ten_seconds():
    demand = crowded(5.0, answered=0.5)
    assert demand.replicas(1, 0.0, 5.0) == 0
    demand = crowded(60.0, answered=0.5)
    demand.answered(says(waiting=0), 60.0)
    demand.asked(60.0)
    assert demand.replicas(0, 0.0, 65.0) == 3, "none counts as one"
    assert demand.replicas(1, 0.0, 69.0) == 0
    late = crowded(60.0, answered=0.5).replicas(1, 0.0, 90.0)
    assert late == 0, "it was full when it was last asked"


@pytest.mark.parametrize(("per_s", "able", "needed"), [(9.0, 1, 0), (20.0, 1, 3), (20.0, 3, 0)])
def test_more_replicas_are_needed_where_those_there_are_nearly_full(per_s, able, needed):
    """At 100 ms a request, one does ten a second; asked for is what leaves a fifth free."""
    demand = Demand()
    for number in range(int(100 * per_s)):
        demand.asked(number / per_s)
    assert demand.replicas(able, 0.1, 100.0) == needed


def test_without_replicas_one_request_is_no_flood():
    demand = Demand()
    assert demand.replicas(0, 0.1, 0.0) == 0
    demand.asked(0.0)
    assert demand.replicas(0, 0.1, 0.0) == 0
    for _ in range(100):
        demand.asked(0.0)
    assert demand.replicas(0, 0.1, 0.0) == 2, "none counts as one, which is not enough"


def test_what_was_asked_fades_to_a_third_in_ten_seconds():
    demand = Demand()
    for _ in range(1000):
        demand.asked(0.0)
    at_once, later = (demand.replicas(1, 0.1, now) for now in (0.0, 10.0))
    assert (at_once, later) == (math.ceil(10 / 0.8), math.ceil(10 / math.e / 0.8))
    assert demand.replicas(1, 0.1, 100.0) == 0


# -- what is believed of one replica ----------------------------------------------------------


def test_one_that_nobody_has_asked_is_taken_for_like_the_others_and_is_free():
    """Where nobody has been asked, the fewest requests ahead count."""
    found = ReplicaLoad()
    assert (found.expected_s(0.0, 0.1, 0.1), found.wait_s(0.0), found.ahead(0.0)) == (0.1, 0.0, 0)
    assert found.free(0.0)
    unknown, asked = ReplicaLoad(), ReplicaLoad()
    asked.asked(A, 0.0)
    assert unknown.expected_s(1.0, 0.0, 0.0) < asked.expected_s(1.0, 0.0, 0.0)
    assert not found.avoided(0.0)
    assert found.oldest_begun == NEVER
    assert found.delay_s == UNKNOWN_DELAY_S


@pytest.mark.parametrize(
    ("waiting", "running", "slots", "wait_s"),
    [(0, 0, 1, 0.0), (0, 1, 1, 0.1), (2, 1, 1, 0.3), (0, 1, 2, 0.0), (1, 2, 2, 0.2)],
)
def test_the_wait_is_until_a_slot_is_free_at_the_pace_of_all_slots(waiting, running, slots, wait_s):
    found = known(slots=slots)
    found.heard(A, says(waiting, running, slots), 10.0)
    assert found.wait_s(10.5) == pytest.approx(wait_s)
    assert found.free(10.5) is (wait_s == 0.0)


def test_what_others_have_there_is_believed_for_a_second():
    found = known()
    found.heard(A, says(running=1), 10.0)
    assert (found.ahead(10.99), found.ahead(11.0)) == (1, 0)
    assert not found.free(10.99)
    assert found.free(11.0)


def test_one_that_is_nearly_over_is_none_more_to_wait_for():
    """But only one, and ours: callers ask again as soon as the first has answered."""
    found = known()
    found.asked(A, 20.0)
    nearly = 20.0 + NEARLY * 0.1
    assert not found.free(nearly - 0.001)
    assert found.free(nearly + 0.001)
    assert not found.free(20.125), "it takes longer than it should"
    found.asked(B, 20.01)
    assert not found.free(nearly + 0.001)
    found.dropped(B)
    found.heard(C, says(running=3), 20.05)
    assert not found.free(nearly + 0.001), "two of others are there"


def test_one_begins_when_the_one_before_it_has_ended():
    found = known()
    found.asked(A, 20.0)
    found.asked(B, 20.0)
    found.answered(A, None, 20.1)
    assert not found.free(20.1 + NEARLY * 0.1 - 0.001)
    assert found.free(20.1 + NEARLY * 0.1 + 0.001)


def test_what_is_at_work_counts_for_what_is_left_of_it():
    found = known()
    found.asked(A, 20.0)
    assert found.expected_s(20.0, 0.1, 0.1) == pytest.approx(0.2)
    assert found.expected_s(20.06, 0.1, 0.1) == pytest.approx(0.14)
    assert found.expected_s(20.11, 0.1, 0.1) == pytest.approx(0.12), "an idle one is sure"
    assert found.expected_s(20.2, 0.1, 0.1) == pytest.approx(0.2), "it takes longer than it should"
    assert found.expected_s(20.5, 0.1, 0.1) == pytest.approx(0.7), "and so it may for as long again"


@pytest.mark.parametrize(
    ("service_s", "taken_for"),
    [(0.2, 0.2), (0.33, 0.2), (0.35, 0.35), (0.12, 0.2), (0.11, 0.11)],
)
def test_one_that_is_about_as_quick_as_most_is_taken_for_their_like(service_s, taken_for):
    found = known(service_s, service_s=service_s)
    assert found.expected_s(20.0, 0.2, 0.2) == pytest.approx(taken_for)


@pytest.mark.parametrize(("lately_s", "taken_for"), [(0.79, 0.2), (0.81, 0.81), (0.051, 0.2)])
def test_of_one_that_is_otherwise_than_usual_only_much_counts(lately_s, taken_for):
    found = known(0.2, service_s=0.2, count=200)
    found.asked(A, 20.0)
    found.heard(A, says(service_s=lately_s), 20.1)
    found.answered(A, says(service_s=lately_s), 20.1)
    assert found.expected_s(20.1, 0.2, 0.2) == pytest.approx(taken_for, rel=0.01)


def test_the_round_trip_shrinks_at_once_and_grows_slowly():
    """A short one proves that the way is short; a long one may be chance."""
    found = known(0.15)
    assert found.expected_s(20.0, 0.1, 0.1) == pytest.approx(0.15)
    for took_s, expected_s in ((0.11, 0.11), (0.21, 0.12), (0.05, 0.1)):
        found.asked(A, 20.0)
        found.answered(A, says(), 20.0 + took_s)
        assert found.expected_s(20.5, 0.1, 0.1) == pytest.approx(expected_s)


def test_what_is_sent_within_the_last_round_trip_it_cannot_have_seen():
    found = known(0.15)  # 50 ms of which are the way
    for request, at in ((A, 20.0), (B, 20.02), (C, 20.09)):
        found.asked(request, at)
    found.heard(A, says(running=1), 20.1)
    found.answered(A, says(running=1), 20.1)
    assert found.ahead(20.1) == 2, "B is the one that it has, C is on its way"
    found.heard(B, says(running=0), 20.2)
    found.answered(B, None, 20.2)
    assert found.ahead(20.2) == 0, "C should be there by now: it was lost"


@given(
    st.lists(
        st.tuples(st.sampled_from([A, B, C]), st.integers(0, 3), st.integers(0, 5)), max_size=40
    )
)
def test_there_is_never_less_than_nothing_and_no_wait_without_somebody_ahead(steps):
    found, now = ReplicaLoad(), 0.0
    for request, step, count in steps:
        now += 0.07
        if step == 0:
            found.asked(request, now)
        elif step == 1:
            found.heard(request, says(waiting=count), now)
            found.answered(request, says(waiting=count), now)
        elif step == 2:
            found.dropped(request)
        else:
            found.failed(request, now)
        assert found.ahead(now) >= 0
        assert found.expected_s(now, 0.1, 0.1) >= 0
        assert found.wait_s(now) == 0.0 or found.ahead(now)
        assert found.free(now) is (found.wait_s(now) == 0.0) or not found.service_s
        assert found.oldest_begun <= now or found.oldest_begun == NEVER
    found.forget()
    assert found.oldest_begun == NEVER


# -- what is unusual --------------------------------------------------------------------------


def test_what_takes_unusually_long_is_learned_from_a_few_answers_on():
    assert known(0.3, count=4).delay_s == UNKNOWN_DELAY_S
    assert known(0.3, count=5).delay_s == pytest.approx(0.3, rel=0.11)
    assert known(1e-6, count=10, service_s=0.0).delay_s == SHORTEST_DELAY_S


def test_an_attempt_is_overdue_later_where_others_are_before_it():
    found = known()
    found.asked(A, 20.0)
    found.asked(B, 20.0)
    assert found.overdue_at(A, 20.0) == pytest.approx(20.12, abs=0.02)
    assert found.overdue_at(B, 20.0) == pytest.approx(20.24)
    assert found.overdue_at(C, 20.0) == 20.0 + found.delay_s, "one that it does not have"


def test_one_of_which_little_is_known_is_doubted_after_seconds_only():
    assert known(count=4).doubtful_at(20.0) == 22.0
    found = known(count=5)
    assert found.doubtful_at(20.0) == pytest.approx(20.2, rel=0.02)
    assert not found.doubt(20.0, found.doubtful_at(20.0) - 0.001)
    assert found.doubt(20.0, found.doubtful_at(20.0))
    assert (found.wait_s(21.0), found.free(21.0), found.avoided(21.0)) == (NEVER, False, True)
    found.forget()
    assert found.wait_s(21.0) == 0.0, "its link is a new one"


def test_only_what_was_slow_already_is_learned_of_what_was_stopped():
    found = known()
    before = found.latencies.samples
    found.overtaken(A, 20.0, 20.0 + 0.9 * found.delay_s)
    assert found.latencies.samples == before
    found.overtaken(A, 20.0, 20.5)
    assert found.latencies.samples == before + 1


def test_an_answer_to_what_is_not_known_says_that_it_lives_and_no_more():
    found = known()
    found.doubted = True
    found.answered(B, says(service_s=9.0, spent_s=0.0), 20.0)
    assert (found.doubted, found.ended_at) == (False, 20.0)
    assert found.expected_s(20.0, 0.1, 0.1) == pytest.approx(0.1)


def test_one_that_never_tells_its_load_is_judged_by_how_long_it_takes():
    found = ReplicaLoad()
    for number in range(10):
        found.asked(A, float(number))
        found.answered(A, None, number + 0.5)
    assert found.service_s == pytest.approx(0.5, rel=0.11)
    assert found.expected_s(20.0, 0.5, 0.5) == pytest.approx(0.5, rel=0.11)


# -- latencies --------------------------------------------------------------------------------


def test_before_the_first_answer_nothing_is_known():
    found = Latencies()
    assert found.quantile_s(0.5) is None
    assert found.mean_below_s(0.5) is None


@example(values=[0.0002, 1000.0], share=0.5)
@given(st.lists(st.floats(0.0002, 1000), min_size=1, max_size=60), st.floats(0.5, 0.95))
def test_the_mean_of_the_fastest_is_theirs_whatever_the_slowest_take(values, share):
    """To within a bucket: one that took an hour must not count for the others."""
    found = Latencies()
    found.per_sample = 1.0
    for value in values:
        found.add(value, 0.0)
    left, total = share * len(values), 0.0
    for value in sorted(values):
        total += value * min(1.0, left)
        left -= min(1.0, left)
    assert found.mean_below_s(share) == pytest.approx(total / (share * len(values)), rel=0.11)


def test_no_latency_is_too_short_or_too_long_to_be_counted():
    found = Latencies()
    for took_s in (0.0, 1e-9, 1e9):
        found.add(took_s, 0.0)
    assert found.samples == 3
    assert found.quantile_s(0.3) == pytest.approx(1e-4, rel=0.11)
    assert found.quantile_s(0.99) > 86400


def test_a_clock_that_stands_or_goes_back_makes_no_sample_heavier():
    by_clock, without = Latencies(), Latencies()
    for number in range(20):
        by_clock.add(0.1 + number, 100.0 - number)
        without.add(0.1 + number, 0.0)
    assert by_clock.quantile_s(0.5) == pytest.approx(without.quantile_s(0.5))
