"""How long a replica serves on, whoever brings it the manager's leases, and when."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.proxy.replica.serving_lease import HeldLease
from tests.fakes.proxy import Clock, lease

DAY_S = 86_400.0


def test_without_a_lease_it_never_ends():
    held = HeldLease(Clock())
    assert (held.age_s, held.left_s) == (None, None)


def test_a_new_lease_prolongs_it_and_an_old_one_does_not():
    clock = Clock()
    held = HeldLease(clock)
    held.renew(lease(1, at=0.0, lasts_s=DAY_S))
    clock.now += 3600.0
    held.renew(lease(2, at=3600.0, lasts_s=DAY_S))
    assert (held.age_s, held.left_s) == (0.0, DAY_S)
    clock.now += 60.0
    held.renew(lease(1, at=0.0, lasts_s=DAY_S))
    held.renew(lease(2, at=3600.0, lasts_s=DAY_S))
    assert (held.age_s, held.left_s) == (60.0, DAY_S - 60.0)


def test_a_new_manager_s_first_lease_is_newer_than_all_of_the_old_one_s():
    clock = Clock()
    held = HeldLease(clock)
    held.renew(lease(900, epoch=1, at=0.0, lasts_s=60.0))
    clock.now += 30.0
    held.renew(lease(1, epoch=2, at=30.0, lasts_s=60.0))
    assert held.left_s == 60.0


@given(st.lists(st.floats(0, 3 * DAY_S), min_size=1, max_size=30))
def test_leases_that_were_held_back_keep_nothing_alive(delays):
    """A hostile robot shows them one by one, as late as it likes, and wins not one second."""
    clock = Clock()
    began = clock.now
    held = HeldLease(clock)
    held.renew(lease(0, at=0.0, lasts_s=DAY_S))
    for number, delay in enumerate(delays, start=1):
        clock.now += delay
        held.renew(lease(number, at=60.0 * number, lasts_s=DAY_S))
        assert held.left_s is not None
        signed_at = began + 60.0 * number
        assert held.left_s <= max(0.0, signed_at + DAY_S - clock.now) + 1e-6


@given(st.lists(st.tuples(st.floats(0, DAY_S), st.floats(-1e6, 1e6)), max_size=30))
def test_a_clock_that_is_set_ends_no_replica_early(steps):
    """Neither the manager's clock nor a successor's on another machine; nor is it ever late."""
    clock, at, longest = Clock(), 1e8, 0.0
    held = HeldLease(clock)
    for number, (wait, jump) in enumerate([(0.0, 0.0), *steps]):
        clock.now += wait
        at += wait + jump
        before = held.left_s
        held.renew(lease(number, at=at, lasts_s=DAY_S))
        longest = max(longest, clock.now + DAY_S)
        assert held.left_s is not None
        assert before is None or held.left_s >= before - 1e-6
        assert clock.now + held.left_s <= longest + 1e-6


@pytest.mark.parametrize(("fast_h", "lasts_h"), [(2, 1), (13, 12), (25, 24)])
def test_a_manager_s_clock_that_was_fast_and_is_set_right_ends_no_replica(fast_h, lasts_h):
    clock, at = Clock(), 1e9 + 3600.0 * fast_h
    held = HeldLease(clock)
    for minute in range(60 * (lasts_h + 2)):
        if minute == 10:
            at -= 3600.0 * fast_h
        held.renew(lease(minute, at=at, lasts_s=3600.0 * lasts_h))
        assert held.left_s >= 3600.0 * lasts_h - 60.0
        clock.now += 60.0
        at += 60.0


def test_whoever_looks_while_the_first_lease_is_taken_sees_all_of_it_or_none():
    """Probes are answered by another thread: a lease of no time would be told to people."""
    seen = set()

    class Seen(HeldLease):
        def __setattr__(self, name, value):
            super().__setattr__(name, value)
            if vars(self).keys() >= {"_ahead", "_heard_at", "_ends_at"}:
                seen.add((self.age_s, self.left_s))

    Seen(Clock()).renew(lease(1, at=0.0, lasts_s=DAY_S))
    assert seen == {(None, None), (0.0, DAY_S)}
