"""What is known of a replica's load, the budget, and whom `auto` asks when."""

from __future__ import annotations

import random
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.requests.auto import BUDGET_CAPACITY, Auto, Spares
from fogft.requests.latency import Latencies
from fogft.requests.load import NEVER, Load, ReplicaLoad

A, B = b"a" * 16, b"b" * 16


def idle(service_s: float, spent_s: float | None = None) -> Load:
    """What a replica says that has nothing more to do."""
    return Load(0, 0, 0, service_s, service_s if spent_s is None else spent_s)


@given(st.lists(st.floats(0.0002, 1000), min_size=1, max_size=200), st.floats(0.5, 0.99))
def test_a_quantile_is_right_to_a_bucket(values, share):
    """Without decay it lies at the sample's own quantile, to within 10 %."""
    found = Latencies()
    found.per_sample = 1.0
    for value in values:
        found.add(value, 0.0)
    ordered = sorted(values)
    quantile = found.quantile_s(share)
    assert quantile is not None
    below = ordered[max(0, int(share * len(values) - 1e-9) - 1)]
    above = ordered[min(len(values) - 1, int(share * len(values) + 1e-9))]
    assert below / 1.11 <= quantile <= above * 1.11


def test_old_latencies_fade_with_samples_and_with_time():
    by_samples, by_time = Latencies(), Latencies()
    by_samples.per_sample, by_time.half_life_s = 2 ** (1 / 20), 10
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
    found = Latencies()
    found.per_sample, found.half_life_s = 2.0, 0.1
    for n in range(5000):
        found.add(0.2, n * 60.0)
    assert found.quantile_s(0.95) == pytest.approx(0.2, rel=0.11)
    assert found.mean_below_s(0.95) == pytest.approx(0.2, rel=0.2)


# -- one replica ------------------------------------------------------------------------------


def test_the_round_trip_is_what_the_replica_did_not_spend():
    known = ReplicaLoad()
    known.asked(A, 10.0)
    known.heard(A, idle(0.02), 10.05)
    known.answered(A, idle(0.02), 10.05)
    assert known.expected_s(10.1, 0.02, 0.02) == pytest.approx(0.05)
    assert known.free(10.1)


def test_each_request_before_it_costs_a_service_time_ours_and_those_of_others():
    known = ReplicaLoad()
    known.asked(A, 10.0)
    known.heard(A, Load(2, 1, 0, 0.02, 0.02), 10.02)  # three of other robots
    known.answered(A, Load(2, 1, 0, 0.02, 0.02), 10.02)
    known.asked(B, 10.03)
    assert known.ahead(10.03) == 4
    assert known.expected_s(10.03, 0.02, 0.02) == pytest.approx(0.02 * 5)
    assert not known.free(10.03)
    assert known.ahead(12.0) == 1  # its word holds for a second


def test_its_word_corrects_what_was_lost_on_the_way():
    """Ours that it does not have any more are forgotten, but not what it cannot have seen yet."""
    known = ReplicaLoad()
    for request, at in ((A, 10.0), (B, 10.1), (b"c" * 16, 10.2)):
        known.asked(request, at)
    known.heard(B, Load(0, 0, 0, 0.02, 0.02), 10.15)
    known.answered(B, Load(0, 0, 0, 0.02, 0.02), 10.15)
    assert known.ahead(10.2) == 1


def test_one_that_fails_is_avoided_for_longer_each_time_until_it_answers():
    known = ReplicaLoad()
    waits = []
    for n in range(8):
        known.asked(A, 10.0 * n)
        known.failed(A, 10.0 * n)
        after = (s / 10 for s in range(1, 60) if not known.avoided(10.0 * n + s / 10))
        waits.append(next(after))
    assert waits == sorted(waits)
    assert 5.0 <= waits[-1] < 5.2
    known.asked(A, 100.0)
    known.answered(A, None, 100.1)
    known.asked(A, 101.0)
    known.failed(A, 101.0)
    assert not known.avoided(101.2)


def test_it_is_doubted_when_long_overdue_unless_it_ended_another_meanwhile():
    known = ReplicaLoad()
    for n in range(10):
        known.asked(A, float(n))
        known.answered(A, None, n + 0.1)
    assert not known.doubt(20.0, 20.15)
    assert known.doubt(20.0, 20.3)
    known.asked(A, 30.0)
    known.answered(A, None, 30.1)
    assert not known.avoided(30.1)
    assert not known.doubt(30.0, 31.0)


# -- spare copies -----------------------------------------------------------------------------


def test_spares_that_cost_more_than_they_save_become_fewer_and_are_tried_again():
    spares, seen = Spares(), []
    for n in range(3000):
        spares.request(0.02, 3, n * 0.05)
        seen.append(spares.left_free)
        if n < 10:
            spares.saved(-0.02)
    assert seen[:3] == [0, 1, 2]
    assert seen[20] == 2  # and one has the request
    assert [left for left, before in zip(seen[1:], seen, strict=False) if left < before] == [1, 0]


def test_spares_that_save_more_than_they_cost_stay():
    spares = Spares()
    for n in range(40):
        spares.request(0.02, 3, n * 0.05)
        spares.saved(0.1)
        spares.saved(-0.02)
    assert spares.left_free == 0


def test_some_requests_show_what_more_spares_would_save():
    """And where that is much, all have them, without waiting until they are tried again."""
    spares = Spares()
    for n in range(5):
        spares.request(0.02, 3, n * 0.05)
        spares.saved(-0.02)
    tries = [spares.left_free_by(n.to_bytes(2, "big")) for n in range(0, 65536, 64)]
    assert set(tries) == {1, 2}
    assert 0.01 < tries.count(1) / len(tries) < 0.03
    spares.saved(0.2)
    spares.request(0.02, 3, 0.5)
    spares.request(0.02, 3, 0.55)
    assert spares.left_free == 0


# -- the policy -------------------------------------------------------------------------------


def learned(**service_s: float) -> Auto:
    """Return a policy that knows replicas by what they take: ``r1=0.1`` is replica 1."""
    policy = Auto()
    for name, took_s in service_s.items():
        replica = int(name[1:])
        for n in range(30):
            begun, ended = n * 1.0, n + took_s
            policy.first(A, (replica,), begun)
            policy.heard(A, replica, idle(took_s), ended)
            policy.answered(A, {replica: begun}, replica, idle(took_s), ended)
    return policy


def test_idle_replicas_all_get_a_request_at_once_and_one_copy_is_no_spare():
    policy = learned(r1=0.9, r2=0.1, r3=0.8)
    assert policy.first(B, (1, 2, 3), 31.0) == [2, 1, 3]
    assert [policy.is_spare(B, replica) for replica in (2, 1, 3)] == [False, True, True]


def test_among_equals_any_is_the_first_and_who_was_quick_once_gets_no_more():
    policy, source = learned(r1=0.125, r2=0.125, r3=0.125), random.Random(1)
    policy.first(A, (1,), 30.5)
    policy.answered(A, {1: 30.5}, 1, idle(0.125, 2**-10), 30.5 + 2**-10)
    firsts = Counter[int]()
    for second in range(31, 331):
        request = source.randbytes(16)
        open = dict.fromkeys(policy.first(request, (1, 2, 3), second), float(second))
        first, *others = open
        firsts[first] += 1
        policy.answered(request, open, first, idle(0.125), second + 0.125)
        for other in others:
            policy.late(request, other, second + 0.125, answered=True)
    assert min(firsts[replica] for replica in (1, 2, 3)) > 60


@pytest.mark.parametrize("equals", [2, 3, 5, 8])
def test_each_of_equals_is_the_first_as_often_beside_one_that_is_none(equals):
    """Each within a sixth of its share, beyond four times what chance does."""
    policy = learned(r0=0.9, **{f"r{n}": 0.125 for n in range(1, equals + 1)})
    source, firsts = random.Random(1), Counter[int]()
    for _ in range(600 * equals):
        firsts[policy.first(source.randbytes(16), range(equals + 1), 31.0)[0]] += 1
        for replica in range(equals + 1):
            policy.forget(replica)
    assert set(firsts) == set(range(1, equals + 1))
    assert min(firsts.values()) > 500
    assert max(firsts.values()) < 700


def test_while_replicas_are_busy_a_request_goes_to_one():
    policy = learned(r1=0.1, r2=0.1)
    assert len(policy.first(A, (1, 2), 31.0)) == 2
    assert len(policy.first(B, (1, 2), 31.01)) == 1


def test_a_loser_is_busy_until_it_is_nearly_over_or_says_that_it_has_ended():
    policy = learned(r1=0.1, r2=0.1)
    first, other = policy.first(A, (1, 2), 31.0)
    policy.answered(A, {1: 31.0, 2: 31.0}, first, idle(0.1), 31.04)
    assert policy.first(B, (1, 2), 31.05) == [first]
    policy.answered(B, {first: 31.05}, first, idle(0.1), 31.2)
    policy.late(A, other, 31.25, answered=True)
    assert set(policy.first(A, (1, 2), 31.3)) == {1, 2}


def test_a_late_hedge_goes_to_a_free_replica_after_the_learned_delay_and_takes_a_token():
    policy = learned(r1=0.1, r2=0.1)
    policy.look_at = NEVER
    policy.first(A, (1,), 31.0)
    assert policy.look_at == NEVER  # nobody to hedge it at
    assert policy.more(A, {1: 31.0}, (2,), 31.05) == ()
    assert 31.11 < policy.look_at < 31.13
    before = policy.report()["tokens"]
    assert policy.more(A, {1: 31.0}, (2,), 31.13) == (2,)
    assert policy.report()["tokens"] == before - 1


def test_a_late_hedge_never_goes_to_a_busy_replica():
    policy = learned(r1=0.1, r2=0.1)
    policy.first(A, (1,), 31.0)
    policy.first(B, (2,), 31.1)
    assert policy.more(A, {1: 31.0}, (2,), 31.13) == ()


def test_a_late_hedge_never_goes_to_one_whose_last_answer_took_far_too_long():
    """Where all have become slow it would only make others wait."""
    policy = learned(r1=0.1, r2=0.1)
    policy.first(B, (2,), 30.5)
    policy.answered(B, {2: 30.5}, 2, idle(0.7), 31.2)
    policy.first(A, (1,), 31.2)
    assert policy.more(A, {1: 31.2}, (2,), 31.35) == ()
    policy.first(B, (2,), 31.35)
    policy.answered(B, {2: 31.35}, 2, idle(0.02), 31.37)
    assert policy.more(A, {1: 31.2}, (2,), 31.38) == (2,)


def test_what_a_doubted_replica_has_goes_to_another_though_that_is_busy_and_costs_no_token():
    """Frozen: its probes go unanswered for two seconds, in which it must not keep requests."""
    policy = learned(r1=0.1, r2=0.1)
    policy.first(A, (1,), 31.0)
    policy.first(B, (2,), 31.25)
    before = policy.report()["tokens"]
    assert policy.more(A, {1: 31.0}, (2,), 31.3) == (2,)
    assert policy.report()["tokens"] == before
    assert policy.first(B, (1, 2), 31.4)[0] == 2


def test_it_goes_to_a_queue_once_it_has_waited_for_as_long_as_it_would_there():
    """Sooner it takes from those that wait there more than it gains."""
    policy = learned(r1=0.1, r2=0.1)
    policy.first(A, (1,), 31.0)
    for n in range(5):
        policy.first(bytes([n]) * 16, (2,), 31.25)
    policy.look_at = NEVER
    assert policy.more(A, {1: 31.0}, (2,), 31.3) == ()
    assert policy.look_at == pytest.approx(31.4)  # half of what is between 0.5 and 0.3 s
    assert policy.more(A, {1: 31.0}, (2,), 31.49) == ()
    assert policy.more(A, {1: 31.0}, (2,), 31.51) == (2,)


def test_one_that_never_ends_what_another_answers_is_tried_once_a_second_not_once_for_all():
    """Else it would be found out by nobody: it has had no request alone, and gets no more."""
    policy = learned(r1=0.01, r2=0.01)
    asked = []
    for n in range(100):
        now, request = 31.0 + n * 0.1, bytes([n]) * 16
        open = dict.fromkeys(policy.first(request, (1, 2), now), now)
        asked += [now] if 2 in open else []
        assert 1 in open
        policy.answered(request, open, 1, idle(0.01), now + 0.01)
    assert 9 <= len(asked) <= 12


def test_when_nobody_works_on_a_request_the_next_is_asked_at_once_without_a_token():
    """The first was suspect, or refused it: a copy is replaced, not added."""
    policy = learned(r1=0.1, r2=0.2)
    policy.first(A, (1,), 31.0)
    policy.failed(A, 1, 31.001, fault=False)
    before = policy.report()["tokens"]
    assert policy.more(A, {}, (2,), 31.001) == (2,)
    assert policy.report()["tokens"] == before


def test_one_that_fails_at_once_draws_nothing():
    policy = learned(r1=0.01, r2=0.3)
    policy.first(A, (1,), 31.0)
    policy.failed(A, 1, 31.001, fault=True)
    assert policy.first(B, (1, 2), 31.002)[0] == 2


def test_a_full_window_turns_it_to_another():
    policy = learned(r1=0.1, r2=0.2)
    policy.first(A, (1,), 31.0)
    policy.declined(A, 1, full=True)
    assert policy.more(A, {}, (1, 2), 31.0) == (2,)


def test_a_burst_does_not_queue_at_one_replica():
    policy = learned(r1=0.1, r2=0.15)
    chosen = [policy.first(bytes([n]) * 16, (1, 2), 31.0)[0] for n in range(6)]
    assert set(chosen) == {1, 2}


def test_a_link_that_was_opened_again_has_nothing_on_the_way():
    policy = learned(r1=0.1, r2=0.1)
    policy.first(A, (1, 2), 31.0)
    policy.forget(1)
    policy.forget(2)
    assert len(policy.first(B, (1, 2), 31.01)) == 2
    assert not policy.is_spare(A, 2)


def test_spares_at_a_replica_that_is_gone_are_not_blamed_for_ever():
    policy = learned(r1=0.1, r2=0.1)
    first, other = policy.first(A, (1, 2), 31.0)
    policy.answered(A, {1: 31.0, 2: 31.0}, first, idle(0.1), 31.1)
    policy.forget(other)
    for n in range(20):
        policy.first(bytes([n]) * 16, (first,), 31.2)
    assert policy.report()["left_free"] == 0


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 2), st.booleans()), max_size=200))
def test_whatever_happens_late_hedges_stay_within_the_budget(steps):
    """Law: late hedges <= capacity + share * requests; and a request always has a first copy."""
    policy, now, open_by = Auto(), 100.0, dict[bytes, dict[int, float]]()
    for n, (kind, replica, flag) in enumerate(steps):
        now += 0.05
        request = n.to_bytes(16, "big")
        if kind <= 1:
            chosen = policy.first(request, (0, 1, 2), now)
            assert chosen
            assert not policy.is_spare(request, chosen[0])
            open_by[request] = dict.fromkeys(chosen, now)
        for known, open in list(open_by.items())[-3:]:
            if kind == 2 and replica in open:
                policy.answered(known, open, replica, idle(0.05) if flag else None, now)
                del open_by[known]
            elif kind == 3 and replica in open:
                del open[replica]
                policy.failed(known, replica, now, fault=flag)
            elif kind == 4:
                others = [r for r in range(3) if r not in open]
                open.update(dict.fromkeys(policy.more(known, open, others, now), now))
            elif kind == 5:
                policy.late(known, replica, now, answered=flag)
    assert policy.hedges <= BUDGET_CAPACITY + 0.1 * len(steps)


# -- how many are needed ------------------------------------------------------------------------


def test_what_replicas_took_that_are_gone_does_not_count_in_how_many_are_needed():
    """Those before took a tenth: by the times of all that ever were, one would do."""
    auto, now = Auto(), 0.0
    for replica, service_s in ((1, 0.1), (2, 0.1), (3, 1.0)):
        for number in range(100):
            request = number.to_bytes(16, "big")
            now += 0.5
            auto.first(request, (replica,), now)
            auto.answered(request, {replica: now}, replica, idle(service_s), now + service_s)
        auto.forget(replica)
    assert auto.needed((3,), now) == 3
