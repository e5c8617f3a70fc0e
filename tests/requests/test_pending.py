"""One service's requests with what chooses and what decides: every step keeps them together."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import pytest

from fogft.model.choices import FallbackSpec
from fogft.model.refusal import Refusal
from fogft.requests.alarms import ALARM_S, FALSE_ALARMS, LATELY_S
from fogft.requests.choose import All
from fogft.requests.decide import Decide, Means
from fogft.requests.fallback import FallbackTimer
from fogft.requests.first_response import Verdict
from fogft.requests.pending import PendingRequests

A = b"a" * 16
OK, NO = b"ok", b"no"


@dataclass
class Item:
    payload: bytes


class Spy(Decide):
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
    assert (len(requests.table), requests.held_bytes, spy.ended) == (0, 0, [A])
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
    assert (len(requests.table), spy.ended) == (1, [])


def test_the_fallback_ends_a_request_once():
    requests, spy = made()
    requests.fallback = FallbackTimer(FallbackSpec("/f", after_s=1.0))
    assert requests.fallback_from(A, 0.0, able=True) == 1.0
    assert requests.fallback.due(1.0, able=True) == [A]
    pending, overdue = requests.fallback_answered(A, 2.0, ok=True)
    assert (pending is not None, overdue, spy.ended) == (True, False, [A])
    assert answer(requests, 1, OK)[1] is None


def wolf(requests: PendingRequests[Item], number: int, now: float) -> int:
    """Have replica 0 say that its service died over a request, and 1 answer it; return deaths."""
    id = bytes([number]) * 16
    requests.begin(id, Item(b"x"), (0, 1), deadline=9999.0, now=now)
    for replica in (0, 1):
        requests.attempt(id, replica, now)
    requests.refused(id, 0, Refusal.CRASHED, now)
    deaths = requests.get(id).deaths
    requests.answered(id, id, 1, OK, True, None, now)
    return deaths


def test_who_cries_wolf_is_not_believed():
    """A replica whose service dies over all that others answer has nothing run alone, for long."""
    requests: PendingRequests[Item] = PendingRequests(All(), Spy(), counts_deaths=True)
    deaths = [wolf(requests, n, n * ALARM_S) for n in range(FALSE_ALARMS + 2)]
    assert deaths == [1] * FALSE_ALARMS + [0, 0]
    requests.begin(A, Item(b"x"), (0, 1), deadline=99.0, now=0.0)
    requests.attempt(A, 1, 0.0)
    requests.refused(A, 1, Refusal.CRASHED, 1.0)
    assert requests.get(A).deaths == 1, "the other one is"
    assert wolf(requests, 99, FALSE_ALARMS * ALARM_S + LATELY_S) == 1, "it may have been mended"


def test_one_death_over_many_requests_is_one_alarm():
    """All that a service had ends with it: that others answer most of it makes nobody a liar."""
    requests: PendingRequests[Item] = PendingRequests(All(), Spy(), counts_deaths=True)
    assert [wolf(requests, n, 0.0) for n in range(100)] == [1] * 100


def test_a_replica_whose_service_was_really_killed_is_believed_the_next_time():
    """A request that kills, found out each time, among innocent ones that others answer."""
    requests: PendingRequests[Item] = PendingRequests(All(), Spy(), counts_deaths=True)
    for n in range(3 * FALSE_ALARMS):
        now = 2 * n * ALARM_S
        requests.begin(A, Item(b"x"), (0, 1), deadline=9999.0, now=now)
        requests.attempt(A, 0, now)
        requests.refused(A, 0, Refusal.CRASHED, now)
        assert wolf(requests, n, now) == 1
        requests.give_up(A, now)
