"""The laws of first response: one answer a request, the first success, never a late one."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from fogft.requests.first_response import RETRY_FIRST_S, RETRY_LIMIT_S, FirstResponse, Verdict
from tests.nightly import by_day

A = b"a" * 16
B = b"b" * 16


def registered(*replicas: int, deadline: float = 10.0) -> FirstResponse[str]:
    requests: FirstResponse[str] = FirstResponse()
    requests.register(A, deadline=deadline, item="a", replicas=replicas)
    return requests


def test_the_first_success_wins_and_later_ones_are_late():
    requests = registered(0, 1)
    pending = requests.succeeded(A, now=1.0)
    assert pending is not None
    assert pending.item == "a"
    assert requests.succeeded(A, now=1.1) is None


def test_a_success_at_the_deadline_is_late():
    assert registered(0, deadline=5.0).succeeded(A, now=5.0) is None


def test_an_answer_to_an_unknown_request_is_late():
    assert registered(0).succeeded(B, now=1.0) is None


def test_the_same_id_cannot_be_registered_twice():
    with pytest.raises(ValueError, match="registered already"):
        registered(0).register(A, deadline=1.0, item="again")


def test_failures_leave_the_request_open_until_nobody_works_on_it():
    requests = registered(0, 1)
    assert requests.failed(A, 0, 0.0, counts=True) is Verdict.WAIT
    assert requests.failed(A, 1, 0.0, counts=True) is Verdict.IDLE
    assert requests.idle() == [A]


def test_a_rejection_is_kept_and_its_replica_not_asked_again():
    requests = registered(0, 1)
    assert requests.rejected(A, 0, b"no") is Verdict.WAIT
    assert requests.attempt(A, 0) is None
    pending = requests.get(A)
    assert pending is not None
    assert pending.rejection == b"no"


def test_a_replica_that_failed_too_often_is_barred():
    requests = registered(0)
    for _ in range(3):
        requests.failed(A, 0, 0.0, counts=True)
        requests.attempt(A, 0)
    assert requests.attempt(A, 0) is None


def test_a_lost_link_never_bars_a_replica():
    """A replica whose link was lost may never have seen the request."""
    requests = registered(0)
    for _ in range(10):
        assert requests.failed(A, 0, 0.0, counts=False) is Verdict.IDLE
        assert requests.attempt(A, 0) is not None


def may_ask(requests: FirstResponse[str], replica: int, now: float = 0.0) -> bool:
    """Whether a replica may be asked for request A, and somebody looks whether it should be."""
    return any(
        request == A and requests.candidates(pending, [replica], now)[0]
        for request, pending in requests.short(0.0)[0]
    )


def test_a_reopened_link_gets_what_was_in_flight_on_it():
    requests = registered(0, 1)
    requests.failed(A, 0, 0.0, counts=False)
    assert not may_ask(requests, 0)  # left alone for a moment
    requests.came(0)
    assert may_ask(requests, 0)
    assert not may_ask(requests, 1)


def test_a_newcomer_gets_what_others_work_on():
    """Those others may be frozen, and the newcomer the only one that answers."""
    requests = registered(0)
    assert not may_ask(requests, 7)
    requests.came(7)
    assert may_ask(requests, 7)


def test_a_replica_that_declined_may_be_asked_while_another_works_on_the_request():
    requests = registered(0, 1)
    assert not may_ask(requests, 1)
    requests.declined(A, 1)
    assert (may_ask(requests, 0), may_ask(requests, 1)) == (False, True)


def test_a_replica_that_failed_is_left_alone_longer_each_time():
    """Else a replica whose service is away is asked fifty times a second."""
    requests = registered(0)
    now, waits = 0.0, []
    for _ in range(8):
        requests.failed(A, 0, now, counts=False)
        wait = next(n for n in range(1000) if may_ask(requests, 0, now + n / 100))
        waits.append(wait / 100)
        now += wait / 100
        requests.attempt(A, 0)
    assert waits == sorted(waits)
    assert (waits[0], waits[-1]) == (RETRY_FIRST_S, RETRY_LIMIT_S)


def test_nobody_is_asked_for_a_request_that_has_ended():
    requests = registered(0, 1)
    requests.declined(A, 1)
    requests.succeeded(A, 0.0)
    requests.came(2)
    requests.reconsider()
    assert requests.short(0.0)[0] == []
    assert requests.idle() == []


def test_a_request_that_not_all_were_asked_for_is_looked_at_again():
    """A policy that began with one replica wants to be asked about the next."""
    requests: FirstResponse[str] = FirstResponse()
    requests.register(A, deadline=1.0, item="", replicas=[0], now=0.5, complete=False)
    assert may_ask(requests, 1)
    pending = requests.get(A)
    assert pending is not None
    assert pending.open == {0: 0.5}


def test_every_request_is_put_before_another_policy():
    requests = registered(0)
    requests.reconsider()
    assert may_ask(requests, 1)


def test_a_shorter_deadline_does_not_wait_for_a_longer_one():
    """The time-out changes with the pool file while requests are under way."""
    requests: FirstResponse[str] = FirstResponse()
    requests.register(A, deadline=100.0, item="old policy")
    requests.register(B, deadline=5.0, item="new policy")
    assert [request for request, _ in requests.expire(5.0)] == [B]


def test_expiry_is_in_order_and_complete():
    requests: FirstResponse[int] = FirstResponse()
    for n in range(5):
        requests.register(bytes([n]) * 16, deadline=float(n), item=n)
    assert [pending.item for _, pending in requests.expire(2.0)] == [0, 1, 2]
    assert len(requests) == 2


@given(
    st.lists(
        st.tuples(st.sampled_from([A, B]), st.integers(0, 3), st.floats(0, 20), st.booleans()),
        max_size=40,
    )
)
def test_no_request_is_answered_twice_or_after_its_deadline(answers):
    """Whatever order answers come in, each request has at most one winner, in time."""
    requests: FirstResponse[str] = FirstResponse()
    for request in (A, B):
        requests.register(request, deadline=10.0, item="", replicas=range(4))
    winners: list[tuple[bytes, float]] = []
    for request, replica, now, ok in answers:
        if ok:
            if requests.succeeded(request, now) is not None:
                winners.append((request, now))
        else:
            requests.failed(request, replica, now, counts=True)
    assert len({request for request, _ in winners}) == len(winners)
    assert all(now < 10.0 for _, now in winners)


class Requests(RuleBasedStateMachine):
    """Against a model: every request ends exactly once, as answered or expired."""

    @initialize()
    def begin(self):
        self.table: FirstResponse[int] = FirstResponse()
        self.now = 0.0
        self.next = 0
        self.open: dict[bytes, float] = {}
        self.ended: dict[bytes, str] = {}

    @rule(replicas=st.sets(st.integers(0, 3)))
    def register(self, replicas):
        request = self.next.to_bytes(16, "big")
        self.next += 1
        self.table.register(request, deadline=self.now + 5, item=0, replicas=replicas)
        self.open[request] = self.now + 5

    @precondition(lambda self: self.next)
    @rule(data=st.data(), replica=st.integers(0, 3))
    def answer(self, data, replica):
        request = data.draw(st.integers(0, self.next - 1)).to_bytes(16, "big")
        won = self.table.succeeded(request, self.now) is not None
        expected = request in self.open and self.now < self.open[request]
        assert won == expected
        if won:
            self.end(request, "answered")

    @precondition(lambda self: self.next)
    @rule(data=st.data(), replica=st.integers(0, 3), counts=st.booleans())
    def fail(self, data, replica, counts):
        request = data.draw(st.integers(0, self.next - 1)).to_bytes(16, "big")
        verdict = self.table.failed(request, replica, self.now, counts=counts)
        if request not in self.open:
            assert verdict is Verdict.LATE

    @rule(step=st.floats(0, 3))
    def advance(self, step):
        self.now += step
        for request, _ in self.table.expire(self.now):
            assert self.open[request] <= self.now
            self.end(request, "expired")

    def end(self, request, how):
        assert request not in self.ended
        self.ended[request] = how
        del self.open[request]

    @invariant()
    def nothing_is_lost(self):
        assert len(self.table) == len(self.open)


Requests.TestCase.settings = settings(max_examples=by_day(30, at_night=300), stateful_step_count=30)
TestRequests = Requests.TestCase
