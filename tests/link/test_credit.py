"""What is sent without risk of blocking never exceeds the credit since the last sign."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fogft.byte_limit import SMALL_BYTES
from fogft.link.credit import Credit


def test_a_large_send_is_never_taken():
    assert Credit().take(SMALL_BYTES + 1) is None


def test_small_sends_are_taken_until_the_credit_is_used_up():
    credit = Credit()
    credit.limit_bytes = 1000
    marks = [credit.take(100) for _ in range(4)]
    assert [mark is not None for mark in marks] == [True, True, False, False]


def test_a_sign_gives_back_what_came_before_it():
    credit = Credit()
    credit.limit_bytes = 1000
    first, _ = credit.take(100), credit.take(100)
    assert first is not None
    credit.heard(first)
    assert credit.take(100) is not None
    assert credit.take(100) is None


def test_a_large_send_uses_the_credit_up_until_its_own_sign():
    credit = Credit()
    small = credit.take(10)
    large = credit.queue(1 << 20)
    credit.dequeued()
    credit.heard(small)
    assert credit.take(10) is None
    credit.heard(large)
    assert credit.take(10) is not None


def test_nothing_is_taken_while_the_other_thread_may_be_sending():
    """It may be stuck in the midst of it, and whoever sends then is stuck as well."""
    credit = Credit()
    credit.queue(1)
    assert credit.take(1) is None
    credit.dequeued()
    assert credit.take(1) is not None


def test_signs_out_of_order_take_nothing_back():
    credit = Credit()
    credit.limit_bytes = 1000
    first, second = credit.take(100), credit.take(100)
    credit.heard(second)
    credit.heard(first)
    assert credit.take(700) is not None  # nothing of both is on the way any more


@given(
    st.lists(
        st.tuples(st.sampled_from(["take", "queue", "dequeued", "heard"]), st.integers(0, 70_000))
    )
)
def test_whatever_happens_the_credit_is_kept(steps):
    """A small send is taken only if all on the way, itself included, stays within the credit."""
    credit = Credit()
    marks: list[int] = []
    queued = heard = 0
    for step, number in steps:
        if step == "take":
            mark = credit.take(number)
            if mark is not None:
                assert mark - heard <= Credit.limit_bytes
                assert not queued
                marks.append(mark)
        elif step == "queue":
            marks.append(credit.queue(number))
            queued += 1
        elif step == "dequeued":
            if queued:
                credit.dequeued()
                queued -= 1
        elif marks:
            sign = marks[number % len(marks)]
            credit.heard(sign)
            heard = max(heard, sign)
