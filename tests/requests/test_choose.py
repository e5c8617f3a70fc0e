"""Whom a request is sent to: everybody, or one at a time."""

from __future__ import annotations

import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.requests.auto import Auto
from fogft.requests.choose import All, Failover
from fogft.requests.load import NEVER, Load

A = b"a" * 16


def test_all_go_to_everybody():
    policy = All()
    assert policy.first(A, (1, 2, 3), 0.0) == (1, 2, 3)
    assert policy.more(A, {1: 0.0}, (2, 3), 0.0) == (2, 3)
    assert policy.look_at == NEVER


def test_failover_keeps_one():
    policy = Failover()
    assert {tuple(policy.first(A, (3, 1, 2), n)) for n in range(5)} == {(3,)}
    assert policy.more(A, {3: 0.0}, (1, 2), 1.9) == ()
    assert policy.switched == 0


def test_failover_switches_when_its_replica_is_suspected():
    policy = Failover()
    policy.first(A, (1, 2), 0.0)
    assert policy.first(A, (2,), 1.0) == (2,)
    assert policy.first(A, (1, 2), 2.0) == (2,)
    assert policy.switched == 1


def test_failover_gives_a_failed_request_to_the_next():
    policy = Failover()
    policy.first(A, (1, 2), 0.0)
    policy.failed(A, 1, 0.1, fault=True)
    assert policy.more(A, {}, (2,), 0.1) == (2,)
    assert policy.first(A, (1, 2), 0.2) == (2,)


def test_failover_leaves_a_replica_that_lets_a_deadline_pass():
    """Its service may hang while its server proxy goes on answering probes."""
    policy = Failover()
    policy.first(A, (1, 2), 0.0)
    policy.stopped(A, {1: 0.0}, 5.0, expired=True)
    assert policy.first(A, (1, 2), 5.0) == (2,)


def test_failover_tries_every_replica_in_turn():
    """Two that fail must not keep a third from being tried."""
    policy = Failover()
    tried = []
    for n in range(4):
        (replica,) = policy.first(A, (0, 1, 2), n)
        policy.failed(A, replica, n, fault=True)
        tried.append(replica)
    assert tried == [0, 1, 2, 0]


def test_the_only_replica_is_asked_again_though_it_failed():
    policy = Failover()
    policy.first(A, (1,), 0.0)
    policy.failed(A, 1, 0.1, fault=True)
    assert policy.first(A, (1,), 0.2) == (1,)


@given(st.lists(st.tuples(st.sets(st.integers(0, 3)), st.booleans()), max_size=30))
def test_failover_never_sends_two_copies_and_always_one_where_it_can(steps):
    policy = Failover()
    for n, (able, fails) in enumerate(steps):
        chosen = policy.first(A, sorted(able), float(n))
        assert len(chosen) == min(1, len(able))
        assert set(chosen) <= able
        for replica in chosen:
            assert policy.more(A, {replica: float(n)}, sorted(able - {replica}), n + 0.5) == ()
            if fails:
                policy.failed(A, replica, n + 0.5, fault=True)
            else:
                policy.answered(A, {replica: float(n)}, replica, None, n + 0.9)


def test_failover_asks_another_as_well_when_its_one_is_long_overdue():
    """A frozen service costs a request some of its usual times, and no deadline."""
    policy = Failover()
    for n in range(10):
        policy.first(A, (1, 2), float(n))
        policy.answered(A, {1: float(n)}, 1, None, n + 0.1)
    policy.first(A, (1, 2), 20.0)
    policy.look_at = NEVER
    assert policy.more(A, {1: 20.0}, (2,), 20.15) == ()
    assert 20.15 < policy.look_at < 20.3
    assert policy.more(A, {1: 20.0}, (2,), 20.3) == (2,)
    assert policy.first(b"b" * 16, (1, 2), 20.4) == (2,)
    assert policy.report() == {"switched": 1, "hedges": 1}


@pytest.mark.parametrize("policy", [All, Auto, Failover])
@given(st.lists(st.tuples(st.permutations([0, 1, 2]), st.booleans(), st.booleans()), min_size=1))
def test_of_requests_that_have_ended_nothing_is_kept(policy, ends):
    """Whoever is first, and whether the others have worked on it, are refused, or expire."""
    choose, now = policy(), 0.0
    ids = [bytes([0, number]) + b"request of a test" for number in range(len(ends))]
    for id, (order, worked, expires) in zip(ids, ends, strict=True):
        asked = dict.fromkeys(choose.first(id, (0, 1, 2), now), now)
        first, *others = [replica for replica in order if replica in asked]
        if expires:
            choose.stopped(id, asked, now, expired=True)
            others.append(first)
        else:
            choose.answered(id, asked, first, Load(0, 0, 0, 0.01, 0.01), now + 0.01)
        for replica in others:
            choose.late(id, replica, now + 0.02, answered=worked)
        now += 1.0
    kept = pickle.dumps(choose)
    assert [id for id in ids if id in kept] == []
