"""One service's requests with what chooses and what decides: every step keeps them together."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.choices import FallbackSpec
from fogft.model.refusal import Refusal
from fogft.requests.choose import All
from fogft.requests.decide import FirstSuccess, Means
from fogft.requests.fallback import FallbackTimer
from fogft.requests.first_response import Verdict
from fogft.requests.pending import PendingRequests

A = b"a" * 16
OK, NO = b"ok", b"no"


@dataclass
class Item:
    payload: bytes


class Spy(FirstSuccess):
    """Notes what it is told; only `OK` is a success."""

    def __init__(self) -> None:
        super().__init__(lambda payload: payload == OK)
        self.began_with: list[tuple[bytes, Collection[int]]] = []
        self.ended: list[bytes] = []

    def began(self, request: bytes, pending: Any, able: Collection[int]) -> None:
        self.began_with.append((request, able))

    def closed(self, request: bytes, pending: Any) -> None:
        self.ended.append(request)


def made(able: Sequence[int] = (1, 2)) -> tuple[PendingRequests[Item], Spy]:
    spy = Spy()
    requests: PendingRequests[Item] = PendingRequests(All(), spy)
    requests.begin(A, Item(b"question"), able, deadline=10.0, now=0.0)
    return requests, spy


def answer(requests: PendingRequests[Item], replica: int, payload: bytes, now: float = 1.0):
    reading = requests.decide.read(payload)
    return requests.answered(A, A, replica, payload, reading, None, now)


def test_the_first_success_ends_a_request_and_names_who_stops():
    requests, spy = made()
    assert requests.held_bytes == len(b"question")
    means, pending, losers, _ = answer(requests, 1, OK)
    assert (means, list(losers)) == (Means.SUCCESS, [2])
    assert pending is not None
    assert (len(requests), requests.held_bytes, spy.ended) == (0, 0, [A])
    assert answer(requests, 2, OK)[1] is None  # too late
    assert spy.ended == [A]


def test_a_rejection_is_the_answer_once_nobody_else_can_be_asked():
    requests, spy = made()
    assert answer(requests, 1, NO)[3] is Verdict.WAIT
    assert requests.settle(A, (1, 2)) is None
    assert requests.refused(A, 2, Refusal.MALFORMED, 1.0) is Verdict.IDLE
    pending = requests.settle(A, (1, 2))
    assert pending is not None
    assert (pending.rejection, spy.ended) == (NO, [A])


@pytest.mark.parametrize("refusal", list(Refusal))
def test_what_is_refused_for_good_is_not_asked_there_again(refusal):
    """A final refusal bars its replica from the request; after any other it has its turn again."""
    requests, _ = made((1,))
    requests.refused(A, 1, refusal, 1.0)
    asked = requests.more((1,), 5.0, newest_first=False)
    final = refusal in (Refusal.EXPIRED, Refusal.FORGOTTEN, Refusal.MALFORMED)
    assert asked == ([] if final else [(A, 1)])


def test_an_answer_that_is_about_no_request_changes_nothing():
    requests, spy = made()
    assert requests.answered(b"x" * 16, None, 1, OK, True, None, 1.0)[1:] == (
        None,
        (),
        Verdict.LATE,
    )
    assert (len(requests), spy.ended) == (1, [])


def test_the_fallback_ends_a_request_once():
    requests, spy = made()
    requests.fallback = FallbackTimer(FallbackSpec("/f", after_s=1.0))
    assert requests.fallback_from(A, 0.0, able=True) == 1.0
    assert requests.fallback.due(1.0, able=True) == [A]
    pending, overdue = requests.fallback_answered(A, 2.0, ok=True)
    assert (pending is not None, overdue, spy.ended) == (True, False, [A])
    assert answer(requests, 1, OK)[1] is None


step = st.tuples(
    st.sampled_from(["ok", "no", "refuse", "decline", "stop", "expire", "more"]),
    st.integers(0, 3),
    st.integers(0, 5),
)


@given(st.lists(step, max_size=40))
def test_each_request_is_closed_once_and_its_bytes_are_given_back(steps):
    """Whatever happens in whatever order: as many ends as beginnings, and nothing is held."""
    spy, able = Spy(), (0, 1, 2, 3)
    requests: PendingRequests[Item] = PendingRequests(All(), spy)
    ids = [bytes([n]) * 16 for n in range(6)]
    for n, id in enumerate(ids):
        requests.begin(id, Item(bytes(n)), able, deadline=20.0 + n, now=0.0)
    now = 1.0
    for what, replica, n in steps:
        now += 0.5
        if what in ("ok", "no"):
            payload = OK if what == "ok" else NO
            requests.answered(ids[n], ids[n], replica, payload, payload == OK, None, now)
        elif what == "refuse":
            requests.refused(ids[n], replica, Refusal.CRASHED, now)
        elif what == "decline":
            requests.declined(ids[n], replica)
        elif what == "stop":
            requests.stop(ids[n], now)
        elif what == "expire":
            requests.expire(now)
        else:
            for request, to in requests.more(able, now, newest_first=False):
                requests.attempt(request, to, now)
        assert requests.held_bytes == sum(n for n, id in enumerate(ids) if id in requests)
    requests.expire(100.0)
    assert sorted(spy.ended) == ids
    assert (len(requests), requests.held_bytes) == (0, 0)
