"""When the fallback is asked and how long it is waited for: laws of `FallbackTimer`."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.choices import FallbackSpec
from fogft.requests.decide import Pending
from fogft.requests.fallback import FallbackTimer
from fogft.requests.load import NEVER

A, B, C = b"a" * 16, b"b" * 16, b"c" * 16


def timer(*submitted: tuple[bytes, float], **spec: object) -> FallbackTimer:
    made = FallbackTimer(FallbackSpec("/f", **{"after_s": 1.0, "limit_s": 2.0} | spec))
    for request, at in submitted:
        made.submitted(request, at)
    return made


def item(deadline: float = 5.0) -> Pending:
    return Pending(deadline, b"question", None, 0.0)


@pytest.mark.parametrize(
    ("after_s", "while_none_ready", "able", "at"),
    [
        (1.0, True, True, 11.0),
        (1.0, True, False, 10.0),
        (1.0, False, True, 11.0),
        (1.0, False, False, 11.0),
        (None, True, True, NEVER),
        (None, True, False, 10.0),
        (None, False, False, NEVER),
    ],
)
def test_it_is_asked_after_a_while_or_at_once_where_no_replica_is_ready(
    after_s, while_none_ready, able, at
):
    made = timer((A, 10.0), after_s=after_s, while_none_ready=while_none_ready)
    assert made.look_at(able=able) == at
    if at < NEVER:
        assert made.due(at - 0.01, able=able) == []
        assert made.due(at, able=able) == [A]
    assert made.look_at(able=able) == NEVER
    assert made.due(1e9, able=able) == []


def test_nothing_is_due_without_a_request():
    assert timer().look_at(able=False) == NEVER
    assert timer().due(1e9, able=False) == []


def test_requests_become_due_in_their_order_each_when_its_time_has_come():
    made = timer((A, 0.0), (B, 0.5), (C, 2.0))
    assert made.due(1.6, able=True) == [A, B]
    assert made.look_at(able=True) == 3.0
    assert made.due(3.0, able=True) == [C]


@pytest.mark.parametrize("handed", [True, False])
def test_what_a_replica_has_answered_is_neither_asked_nor_awaited(handed):
    made = timer((A, 0.0))
    if handed:
        assert made.due(1.0, able=True) == [A]
    made.ended(A)
    assert made.due(9.0, able=True) == []
    assert made.answered(A) is None
    made.ended(A)  # not known any more


def test_at_the_deadline_it_is_asked_where_it_has_not_been_and_its_answer_is_awaited():
    made, mine = timer((A, 0.0), after_s=None), item()
    assert made.expired(A, mine, 5.0), "it must be asked now"
    assert len(made) == 1
    assert made.look_at(able=False) == NEVER, "not a second time"
    assert made.answered(A) is mine
    assert len(made) == 0
    assert made.answered(A) is None, "it ends once"


def test_what_it_was_asked_for_already_is_not_asked_again_at_the_deadline():
    made = timer((A, 0.0))
    assert made.due(1.0, able=True) == [A]
    assert not made.expired(A, item(), 5.0)
    assert len(made) == 1


def test_where_it_could_not_be_asked_it_is_tried_again_at_the_deadline():
    made = timer((A, 0.0))
    made.due(1.0, able=True)
    made.failed(A)
    assert made.due(4.9, able=True) == [], "not at once: it would fail again and again"
    assert made.expired(A, item(), 5.0)


def test_an_answer_before_the_deadline_ends_nothing_that_is_awaited():
    """The request is among the pending ones: they end it."""
    made = timer((A, 0.0))
    made.due(1.0, able=True)
    assert made.answered(A) is None
    assert made.expired(A, item(), 5.0), "that answer counted for nothing: it may be asked anew"


def test_a_fallback_that_is_too_slow_is_given_up_in_its_own_time():
    made, first, second = timer(), item(), item()
    made.expired(A, first, 5.0)
    made.expired(B, second, 5.5)
    assert made.given_up(6.9) == []
    assert made.given_up(7.0) == [(A, first)]
    assert made.answered(A) is None, "too late"
    assert made.given_up(9.0) == [(B, second)]
    assert len(made) == 0


_STEPS = st.lists(
    st.tuples(
        st.sampled_from(["submit", "due", "ended", "expired", "answered", "failed", "given up"]),
        st.integers(0, 3),
        st.floats(0, 1.5),
        st.booleans(),
    ),
    max_size=60,
)


@given(_STEPS, st.sampled_from([None, 0.0, 1.0]), st.booleans())
def test_each_request_is_handed_over_at_most_once_and_ends_once(steps, after_s, while_none_ready):
    """Unless it could not be asked: then once more, at the deadline."""
    made = timer(after_s=after_s, while_none_ready=while_none_ready)
    now, number = 0.0, 0
    waiting: dict[bytes, float] = {}  # before their deadline
    handed: dict[bytes, int] = {}
    could_not: set[bytes] = set()
    awaited: dict[bytes, Pending] = {}
    for step, which, pause_s, able in steps:
        now += pause_s
        chosen = sorted(waiting)[which % len(waiting)] if waiting else None
        if step == "submit":
            number += 1
            id = number.to_bytes(16, "big")
            made.submitted(id, now)
            waiting[id], handed[id] = now, 0
        elif step == "due":
            for id in made.due(now, able=able):
                handed[id] += 1
                assert id in waiting
        elif step == "failed" and chosen and handed[chosen]:
            made.failed(chosen)
            could_not.add(chosen)
        elif step == "ended" and chosen:
            made.ended(chosen)
            del waiting[chosen]
        elif step == "expired" and chosen:
            awaited[chosen] = item()
            handed[chosen] += made.expired(chosen, awaited[chosen], now)
            del waiting[chosen]
        elif step == "answered" and awaited:
            id = sorted(awaited)[which % len(awaited)]
            assert made.answered(id) is awaited.pop(id)
        elif step == "given up":
            for id, over in made.given_up(now):
                assert over is awaited.pop(id)
        assert len(made) == len(awaited)
    assert all(count <= 1 + (id in could_not) for id, count in handed.items())
    assert [id for id in awaited if not handed[id]] == []
