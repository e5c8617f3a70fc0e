"""The laws of pending requests: one answer each, the first success, never a late one.

Every step keeps the table, the policy and the decision together.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from fogft.model.choices import FallbackSpec
from fogft.model.refusal import Effect, Refusal
from fogft.requests.alarms import ALARM_S, FALSE_ALARMS, LATELY_S
from fogft.requests.auto import Auto
from fogft.requests.choose import All, Failover
from fogft.requests.decide import Decide, Means
from fogft.requests.fallback import FallbackTimer
from fogft.requests.load import Load
from fogft.requests.pending import (
    ATTEMPTS,
    CAUTIOUS_S,
    RETRY_FIRST_S,
    RETRY_LIMIT_S,
    PendingRequests,
    Verdict,
)
from tests.nightly import by_day

A = b"a" * 16
B = b"b" * 16
OK, NO = b"ok", b"no"


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


def made(able: Sequence[int] = (1, 2)) -> tuple[PendingRequests, Spy]:
    spy = Spy()
    requests = PendingRequests(All(), spy)
    requests.begin(A, b"question", able, deadline=10.0, now=0.0)
    return requests, spy


def answer(requests: PendingRequests, replica: int, payload: bytes, now: float = 1.0):
    reading = requests.decide.read(payload)
    return requests.answered(A, A, replica, payload, reading, None, now)


@pytest.mark.parametrize(("able", "stop"), [((1, 2), [2]), ((2, 1, 3), [2, 3]), ((1,), [])])
def test_the_first_success_ends_a_request_and_names_who_stops(able, stop):
    requests, spy = made(able)
    assert requests.held_bytes == len(b"question")
    means, pending, losers, _ = answer(requests, 1, OK)
    assert (means, list(losers)) == (Means.SUCCESS, stop)
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


def test_what_a_full_replica_refused_is_offered_there_again_once_it_would_be_in_time():
    """Not every few hundredths of a second: under overload that was most of a proxy's work."""
    requests = PendingRequests(Auto(), Decide())
    requests.begin(A, b"question", (1,), deadline=10.0, now=0.0)
    requests.refused(A, 1, Refusal.OVERLOADED, 0.0)

    def offered(now: float, *, waiting: int | None = None) -> bool:
        if waiting is not None:
            requests.choose.heard(B, 1, Load(waiting, 1, 1, 0.1, 0.0), now)
        chosen = requests.more((1,), now, newest_first=False)
        return any(requests.attempt(A, replica, now) for _, replica in chosen)

    assert not offered(0.5, waiting=200)  # 20 s
    assert not offered(0.5 + RETRY_LIMIT_S, waiting=100)  # 10 s
    assert offered(0.5 + 2 * RETRY_LIMIT_S, waiting=50)
    requests.refused(A, 1, Refusal.OVERLOADED, 2.0)
    assert not offered(2.5, waiting=100)
    assert offered(3.5)  # nothing was heard for a second


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
    requests.fallback.submitted(A, 0.0)
    assert requests.fallback.look_at(able=True) == 1.0
    assert requests.fallback.due(1.0, able=True) == [A]
    pending, overdue = requests.fallback_answered(A, 2.0, ok=True)
    assert (pending is not None, overdue, spy.ended) == (True, False, [A])
    assert answer(requests, 1, OK)[1] is None


def wolf(requests: PendingRequests, number: int, now: float) -> int:
    """Have replica 0 say that its service died over a request, and 1 answer it; return deaths."""
    id = bytes([number]) * 16
    requests.begin(id, b"x", (0, 1), deadline=9999.0, now=now)
    for replica in (0, 1):
        requests.attempt(id, replica, now)
    requests.refused(id, 0, Refusal.CRASHED, now)
    deaths = requests.get(id).deaths
    requests.answered(id, id, 1, OK, True, None, now)
    return deaths


def test_who_cries_wolf_is_not_believed():
    """A replica whose service dies over all that others answer has nothing run alone, for long."""
    requests = PendingRequests(All(), Spy(), counts_deaths=True)
    deaths = [wolf(requests, n, n * ALARM_S) for n in range(FALSE_ALARMS + 2)]
    assert deaths == [1] * FALSE_ALARMS + [0, 0]
    requests.begin(A, b"x", (0, 1), deadline=99.0, now=0.0)
    requests.attempt(A, 1, 0.0)
    requests.refused(A, 1, Refusal.CRASHED, 1.0)
    assert requests.get(A).deaths == 1, "the other one is"
    assert wolf(requests, 99, FALSE_ALARMS * ALARM_S + LATELY_S) == 1, "it may have been mended"


@pytest.mark.parametrize("policy", [All, Auto, Failover])
@pytest.mark.parametrize("refusal", [Refusal.OVERLOADED, Refusal.LOST])
def test_one_replica_alone_makes_no_request_poison(policy, refusal):
    """It says each time that its service died; the other one refuses each request once."""
    requests = PendingRequests(policy(), Spy(), counts_deaths=True)
    for n in range(20):
        id, now, refused, ended = bytes([n]) * 16, 10.0 * n, False, False
        step = list(requests.begin(id, b"x", (0, 1), deadline=now + 5.0, now=now))
        while not ended and now < 10.0 * n + 5.0:
            for replica in step:
                if replica == 0:
                    verdict = requests.refused(id, 0, Refusal.CRASHED, now)
                    assert verdict is not Verdict.POISON
                elif not refused:
                    refused = True
                    requests.refused(id, 1, refusal, now)
                else:
                    ended = requests.answered(id, id, 1, OK, True, None, now)[1] is not None
                    break
            now += 0.02
            more = requests.more((0, 1), now, newest_first=False)
            step = [replica for _, replica in more if requests.attempt(id, replica, now)]
        assert ended


@pytest.mark.parametrize("policy", [All, Auto, Failover])
def test_a_request_that_kills_is_found_although_one_replica_is_busy(policy):
    """That one refuses it for as long as it lasts."""
    requests = PendingRequests(policy(), Spy(), counts_deaths=True)
    deaths, verdict, now = 0, None, 0.0
    step = list(requests.begin(A, b"x", (0, 1, 2), deadline=60.0, now=now))
    while verdict is not Verdict.POISON and now < 60.0:
        for replica in step:
            busy = replica == 1
            verdict = requests.refused(
                A, replica, Refusal.OVERLOADED if busy else Refusal.CRASHED, now
            )
            deaths += not busy
            if verdict is Verdict.POISON:
                break
        now += 0.02
        step = [r for r in asked(requests, 0, 1, 2, now=now) if requests.attempt(A, r, now)]
    assert verdict is Verdict.POISON
    assert deaths <= 3


def test_one_death_over_many_requests_is_one_alarm():
    """All that a service had ends with it: that others answer most of it makes nobody a liar."""
    requests = PendingRequests(All(), Spy(), counts_deaths=True)
    assert [wolf(requests, n, 0.0) for n in range(100)] == [1] * 100


def test_a_replica_whose_service_was_really_killed_is_believed_the_next_time():
    """A request that kills, found out each time, among innocent ones that others answer."""
    requests = PendingRequests(All(), Spy(), counts_deaths=True)
    for n in range(3 * FALSE_ALARMS):
        now = 2 * n * ALARM_S
        requests.begin(A, b"x", (0, 1), deadline=9999.0, now=now)
        requests.attempt(A, 0, now)
        requests.refused(A, 0, Refusal.CRASHED, now)
        assert wolf(requests, n, now) == 1
        requests.give_up(A, now)


def test_a_suspect_whose_replica_says_nothing_is_asked_of_another_in_time():
    """It may be innocent, and its answer or its replica lost: half of the time left is enough."""
    requests = PendingRequests(All(), Spy(), counts_deaths=True)
    requests.begin(A, b"x", (0, 1, 2), deadline=80.0, now=0.0)
    for replica in (0, 1, 2):
        requests.refused(A, replica, Refusal.CRASHED, 0.0)
    at, asked_at = 1.0, list[float]()
    while at < 80.0:
        if step := asked(requests, 0, 1, 2, now=at):
            assert len(step) == 1
            requests.attempt(A, step[0], at)
            asked_at.append(at)
        at += 1.0
    assert asked_at == [1.0, 41.0, 61.0]
    assert won(requests, A, 2, 79.0)


def test_copies_that_others_work_on_are_none_more_for_a_death():
    requests = PendingRequests(All(), Spy(), counts_deaths=True)
    requests.begin(A, b"x", (0, 1), deadline=80.0, now=0.0)
    requests.refused(A, 0, Refusal.CRASHED, 0.0)
    assert asked(requests, 0, 1, 2, now=39.0) == []
    assert len(asked(requests, 0, 1, 2, now=40.0)) == 1


# -- first response ---------------------------------------------------------------------------


def won(requests: PendingRequests, request: bytes, replica: int, now: float) -> bool:
    """Have a replica answer well; return whether its answer is the caller's."""
    return requests.answered(request, request, replica, OK, True, None, now)[1] is not None


def asked(requests: PendingRequests, *able: int, now: float = 0.0) -> list[int]:
    """Return which of these replicas request A goes to now, beside those that have it."""
    return [replica for id, replica in requests.more(able, now, newest_first=False) if id == A]


def test_the_first_success_wins_and_later_ones_are_late():
    requests, _ = made()
    assert won(requests, A, 1, 1.0)
    assert not won(requests, A, 2, 1.1)


def test_a_success_at_the_deadline_is_late():
    requests, spy = made()
    assert not won(requests, A, 1, 10.0)
    assert spy.ended == []
    assert [id for id, _ in requests.expire(10.0)] == [A]


def test_an_answer_to_an_unknown_request_is_late():
    requests, _ = made()
    assert not won(requests, B, 1, 1.0)


def test_the_same_id_cannot_be_under_way_twice():
    requests, _ = made()
    with pytest.raises(ValueError, match="under way already"):
        requests.begin(A, b"again", (1,), deadline=1.0, now=0.0)
    assert (len(requests), requests.held_bytes) == (1, len(b"question"))


def test_failures_leave_the_request_open_until_nobody_works_on_it():
    requests, _ = made()
    assert requests.refused(A, 1, Refusal.LOST, 0.0) is Verdict.WAIT
    assert requests.refused(A, 2, Refusal.LOST, 0.0) is Verdict.IDLE


def test_a_rejection_is_kept_and_its_replica_not_asked_again():
    requests, _ = made()
    assert answer(requests, 1, NO)[3] is Verdict.WAIT
    assert requests.attempt(A, 1, 1.0) is None
    assert requests.get(A).rejection == NO
    assert requests.idle() == []
    requests.declined(A, 2)
    assert requests.idle() == [A]


def test_a_replica_that_failed_too_often_is_barred():
    requests, _ = made()
    for _ in range(ATTEMPTS):
        requests.refused(A, 1, Refusal.CRASHED, 0.0)
        last = requests.attempt(A, 1, 0.0)
    assert last is None


def test_a_lost_link_never_bars_a_replica():
    """A replica whose link was lost may never have seen the request."""
    requests, _ = made((1,))
    for _ in range(10):
        assert requests.refused(A, 1, Refusal.LOST, 0.0) is Verdict.IDLE
        assert requests.attempt(A, 1, 0.0) is not None


def test_a_reopened_link_gets_what_was_in_flight_on_it():
    requests, _ = made()
    requests.refused(A, 1, Refusal.LOST, 0.0)
    assert asked(requests, 1, 2) == []  # left alone for a moment
    requests.came([1])
    assert asked(requests, 1, 2) == [1]


def test_a_newcomer_gets_what_others_work_on():
    """Those others may be frozen, and the newcomer the only one that answers."""
    requests, _ = made((1,))
    assert asked(requests, 1, 7) == []
    requests.came([7])
    assert asked(requests, 1, 7) == [7]


def test_a_replica_that_declined_may_be_asked_while_another_works_on_the_request():
    requests, _ = made()
    assert asked(requests, 1, 2) == []
    requests.declined(A, 2)
    assert asked(requests, 1, 2) == [2]


def test_a_replica_that_failed_is_left_alone_longer_each_time():
    """Else a replica whose service is away is asked fifty times a second."""
    requests = PendingRequests(All(), Spy())
    requests.begin(A, b"", (1,), deadline=1000.0, now=0.0)
    now, waits = 0.0, []
    for _ in range(8):
        requests.refused(A, 1, Refusal.LOST, now)
        wait = next(n for n in range(1000) if asked(requests, 1, now=now + n / 100))
        waits.append(wait / 100)
        now += wait / 100
        requests.attempt(A, 1, now)
    assert waits == sorted(waits)
    assert (waits[0], waits[-1]) == (RETRY_FIRST_S, RETRY_LIMIT_S)


def test_nobody_is_asked_for_a_request_that_has_ended():
    requests, _ = made()
    requests.declined(A, 2)
    assert won(requests, A, 1, 0.0)
    requests.came([3])
    requests.use(All())
    assert asked(requests, 1, 2, 3) == []
    assert requests.idle() == []


class Told(All):
    """Notes what it is told of how attempts end."""

    def __init__(self) -> None:
        self.told: list[tuple[Any, ...]] = []

    def declined(self, request: bytes, replica: int, *, full: bool) -> None:
        self.told.append(("declined", request, replica, full))

    def heard(self, request: bytes, replica: int, load: Load, now: float) -> None:
        self.told.append(("heard", request, replica, load))

    def answered(
        self, request: bytes, open: Mapping[int, float], replica: int, load: Load | None, now: float
    ) -> None:
        self.told.append(("answered", request, replica, load))

    def failed(self, request: bytes, replica: int, now: float, *, fault: bool) -> None:
        self.told.append(("failed", request, replica, fault))

    def late(self, request: bytes, replica: int, now: float, *, answered: bool) -> None:
        self.told.append(("late", request, replica, answered))

    def stopped(
        self, request: bytes, open: Mapping[int, float], now: float, *, expired: bool = False
    ) -> None:
        self.told.append(("stopped", request, sorted(open), expired))

    def forget(self, replica: int) -> None:
        self.told.append(("forget", replica))


def told(*steps: Callable[[PendingRequests], object]) -> list[tuple[Any, ...]]:
    """Return what a policy was told while these happened to a request at replicas 1 and 2."""
    policy = Told()
    requests = PendingRequests(policy, Spy())
    requests.begin(A, b"question", (1, 2), deadline=10.0, now=0.0)
    for step in steps:
        step(requests)
    return policy.told


@pytest.mark.parametrize("refusal", list(Refusal))
def test_a_policy_is_told_whose_fault_a_refusal_is(refusal):
    fault = Effect.FAULT in refusal.effect
    assert told(lambda r: r.refused(A, 1, refusal, 1.0)) == [("failed", A, 1, fault)]
    late = told(lambda r: won(r, A, 2, 1.0), lambda r: r.refused(A, 1, refusal, 2.0))
    assert late == [("answered", A, 2, None), ("late", A, 1, False)]


def test_a_policy_is_told_how_each_attempt_ends():
    load = Load(1, 2, 3, 0.1, 0.2)
    rejected = ("failed", A, 1, False)  # the service works, and says no
    assert told(lambda r: answer(r, 1, NO)) == [rejected]
    assert told(lambda r: answer(r, 1, NO), lambda r: answer(r, 1, NO)) == [
        rejected,
        ("late", A, 1, True),
    ]
    assert told(lambda r: won(r, A, 1, 10.0)) == [("late", A, 1, True)], "at the deadline"
    assert told(lambda r: r.answered(A, A, 1, OK, True, load, 1.0)) == [("answered", A, 1, load)]
    late = told(lambda r: won(r, A, 1, 1.0), lambda r: r.answered(A, A, 2, OK, True, load, 2.0))
    assert late == [("answered", A, 1, None), ("heard", A, 2, load), ("late", A, 2, True)]
    assert told(lambda r: r.declined(A, 1)) == [("declined", A, 1, True)]
    assert told(lambda r: r.attempt(A, 1, 1.0)) == [("declined", A, 1, False)], "it has it"
    assert told(lambda r: r.stop(A, 1.0)) == [("stopped", A, [1, 2], False)]
    assert told(lambda r: r.give_up(A, 1.0)) == [("stopped", A, [1, 2], False)]
    assert told(lambda r: r.expire(10.0)) == [("stopped", A, [1, 2], True)]
    assert told(lambda r: r.left([1]), lambda r: r.came([2])) == [("forget", 1), ("forget", 2)]


def test_after_a_death_two_replicas_are_left_out_of_each_request_for_a_while():
    """One more that kills is run alone on one of them, and the other lives on."""
    policy = Told()
    requests = PendingRequests(policy, Spy(), counts_deaths=True)
    requests.begin(A, b"x", (1, 2, 3), deadline=999.0, now=0.0)
    requests.refused(A, 1, Refusal.CRASHED, 0.0)
    assert list(requests.begin(B, b"x", (1, 2, 3), deadline=999.0, now=1.0)) == [1]
    assert policy.told[-2:] == [("declined", B, 2, False), ("declined", B, 3, False)]
    spared = [(id, replica) for id, replica in requests.more((1, 2, 3), 1.5, newest_first=False)]
    assert (B, 3) not in spared
    later = requests.more((1, 2, 3), 2.0, newest_first=False)
    assert (B, 3) in later, "those that have it have lived on"
    begun = requests.begin(b"c" * 16, b"x", (1, 2, 3), deadline=999.0, now=CAUTIOUS_S)
    assert list(begun) == [1, 2, 3]
    assert list(requests.begin(b"d" * 16, b"x", (1,), deadline=999.0, now=1.0)) == [1], "the only"


def test_one_replica_keeps_a_request_from_the_others_for_half_its_time_at_most():
    """After a death, too: a short time-out must not depend on the only replica that was asked."""
    requests = PendingRequests(All(), Spy(), counts_deaths=True)
    requests.begin(A, b"x", (1, 2, 3), deadline=999.0, now=0.0)
    requests.refused(A, 1, Refusal.CRASHED, 0.0)
    assert list(requests.begin(B, b"x", (1, 2, 3), deadline=2.0, now=1.0)) == [1]
    assert (B, 3) not in requests.more((1, 2, 3), 1.4, newest_first=False)
    assert (B, 3) in requests.more((1, 2, 3), 1.5, newest_first=False)


def test_any_answer_of_another_replica_clears_a_request_and_disproves_a_crash():
    """An answer that decides nothing shows it, too: of a quorum, no single one does."""
    requests = PendingRequests(All(), Spy(), counts_deaths=True)
    deaths = []
    for number in range(FALSE_ALARMS + 1):
        id, now = bytes([number]) * 16, number * ALARM_S
        requests.begin(id, b"x", (1, 2, 3), deadline=999.0, now=now)
        requests.refused(id, 1, Refusal.CRASHED, now)
        deaths.append(requests.get(id).deaths)
        requests.attempt(id, 2, now)
        requests.answered(id, id, 2, NO, False, None, now)
        assert not requests.get(id).deaths, "it need not run alone any more"
        requests.attempt(id, 3, now)
        requests.answered(id, id, 3, NO, False, None, now)  # one false alarm, however many answer
    assert deaths == [1] * FALSE_ALARMS + [0], "at last, it is not believed"


def test_what_several_died_over_stays_suspect_though_another_answers():
    requests = PendingRequests(All(), Spy(), counts_deaths=True)
    requests.begin(A, b"x", (1, 2, 3), deadline=999.0, now=0.0)
    for replica in (1, 2):
        requests.refused(A, replica, Refusal.CRASHED, 0.0)
    answer(requests, 3, NO)
    assert requests.get(A).deaths == 1


def test_a_restarted_subject_voids_what_was_said_of_its_requests_only():
    requests, _ = made((1,))
    requests.begin(B, b"other", (1,), deadline=10.0, now=0.0)
    for request in (A, B):
        requests.refused(request, 1, Refusal.MALFORMED, 0.0)
    requests.welcome(1, lambda payload: payload == b"other")
    assert requests.more((1,), 5.0, newest_first=False) == [(B, 1)]


def test_a_fallback_that_fails_leaves_the_request_to_the_replicas_until_its_deadline():
    requests, spy = made()
    requests.fallback = FallbackTimer(FallbackSpec("/f", after_s=1.0))
    requests.fallback.submitted(A, 0.0)
    assert requests.fallback.due(1.0, able=True) == [A]
    assert requests.fallback_answered(A, 2.0, ok=False) == (None, True)
    assert (A in requests, spy.ended) == (True, [])
    assert requests.fallback_answered(A, 10.0, ok=True) == (None, False), "at the deadline"
    ((id, pending),) = requests.expire(10.0)
    assert requests.fallback.expired(id, pending, 10.0), "it is asked again: it had answered"
    assert requests.fallback_answered(A, 11.0, ok=False) == (pending, True)


@pytest.mark.parametrize("newest_first", [False, True])
def test_requests_are_looked_at_in_the_order_that_is_wanted(newest_first):
    requests = PendingRequests(All(), Spy())
    for id in (A, B):
        requests.begin(id, b"", (), deadline=10.0, now=0.0)
    steps = [id for id, _ in requests.more((1,), 0.0, newest_first=newest_first)]
    assert steps == ([B, A] if newest_first else [A, B])


class OneFirst(All):
    """Begins with one replica."""

    def first(self, request: bytes, able: Sequence[int], now: float) -> Sequence[int]:
        return able[:1]


def test_a_request_that_not_all_were_asked_for_is_looked_at_again():
    """A policy that began with one replica wants to be asked about the next."""
    requests = PendingRequests(OneFirst(), Spy())
    requests.begin(A, b"", (0, 1), deadline=1.0, now=0.5)
    assert requests.get(A).open == {0: 0.5}
    assert asked(requests, 0, 1, now=0.5) == [1]


def test_every_request_is_put_before_another_policy():
    requests, _ = made((1,))
    assert asked(requests, 1, 2) == []
    requests.use(All())
    assert asked(requests, 1, 2) == [2]


def test_a_shorter_deadline_does_not_wait_for_a_longer_one():
    """The time-out changes with the pool file while requests are under way."""
    requests = PendingRequests(All(), Spy())
    requests.begin(A, b"old policy", (), deadline=100.0, now=0.0)
    requests.begin(B, b"new policy", (), deadline=5.0, now=0.0)
    assert [request for request, _ in requests.expire(5.0)] == [B]


def test_expiry_is_in_order_and_complete():
    requests = PendingRequests(All(), Spy())
    for n in range(5):
        requests.begin(bytes([n]) * 16, bytes([n]), (), deadline=float(n), now=-1.0)
    assert [pending.payload[0] for _, pending in requests.expire(2.0)] == [0, 1, 2]
    assert len(requests) == 2


@given(
    st.lists(
        st.tuples(st.sampled_from([A, B]), st.integers(0, 3), st.floats(0, 20), st.booleans()),
        max_size=40,
    )
)
def test_no_request_is_answered_twice_or_after_its_deadline(answers):
    """Whatever order answers come in, each request has at most one winner, in time."""
    requests = PendingRequests(All(), Spy())
    for request in (A, B):
        requests.begin(request, b"", range(4), deadline=10.0, now=0.0)
    winners: list[tuple[bytes, float]] = []
    for request, replica, now, ok in answers:
        if not ok:
            requests.refused(request, replica, Refusal.CRASHED, now)
        elif won(requests, request, replica, now):
            winners.append((request, now))
    assert len({request for request, _ in winners}) == len(winners)
    assert all(now < 10.0 for _, now in winners)


class Requests(RuleBasedStateMachine):
    """Against a model: every request ends exactly once, as answered or expired."""

    @initialize()
    def begin(self):
        self.spy = Spy()
        self.requests = PendingRequests(All(), self.spy)
        self.now = 0.0
        self.next = 0
        self.open: dict[bytes, float] = {}
        self.ended: dict[bytes, str] = {}

    @rule(replicas=st.sets(st.integers(0, 3)))
    def register(self, replicas):
        request = self.next.to_bytes(16, "big")
        self.next += 1
        able, deadline = sorted(replicas), self.now + 5
        self.requests.begin(request, b"x", able, deadline=deadline, now=self.now)
        self.open[request] = deadline

    @precondition(lambda self: self.next)
    @rule(data=st.data(), replica=st.integers(0, 3))
    def answer(self, data, replica):
        request = data.draw(st.integers(0, self.next - 1)).to_bytes(16, "big")
        first = won(self.requests, request, replica, self.now)
        expected = request in self.open and self.now < self.open[request]
        assert first == expected
        if first:
            self.end(request, "answered")

    @precondition(lambda self: self.next)
    @rule(data=st.data(), replica=st.integers(0, 3), kind=st.sampled_from(Refusal))
    def fail(self, data, replica, kind):
        request = data.draw(st.integers(0, self.next - 1)).to_bytes(16, "big")
        verdict = self.requests.refused(request, replica, kind, self.now)
        if request not in self.open:
            assert verdict is Verdict.LATE

    @rule(step=st.floats(0, 3))
    def advance(self, step):
        self.now += step
        for request, _ in self.requests.expire(self.now):
            assert self.open[request] <= self.now
            self.end(request, "expired")

    def end(self, request, how):
        assert request not in self.ended
        self.ended[request] = how
        del self.open[request]

    @invariant()
    def nothing_is_lost(self):
        assert len(self.requests) == self.requests.held_bytes == len(self.open)
        assert self.spy.ended == list(self.ended)


Requests.TestCase.settings = settings(max_examples=by_day(30, at_night=300), stateful_step_count=30)
TestRequests = Requests.TestCase
