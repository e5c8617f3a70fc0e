"""What a replica is told of requests that are no longer wanted."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from fogft.link.frame import CANCEL_LIMIT
from fogft.link.window import EVERY_S, WORTH_S, Cancellations

ids = st.binary(min_size=16, max_size=16)


@given(st.lists(st.tuples(st.sampled_from(["add", "answered", "take"]), st.integers(0, 5))))
def test_each_is_told_once_unless_it_was_answered(steps):
    cancellations, model, told = Cancellations(), [], []
    for step, number in steps:
        id = bytes([number]) * 16
        if step == "add":
            cancellations.add(id, 0.0, 0.0)
            model += [] if id in model else [id]
        elif step == "answered":
            cancellations.answered(id)
            model = [other for other in model if other != id]
        else:
            told = cancellations.take()
            assert told == model
            model = []
        assert bool(cancellations) == bool(model)


def test_they_are_bounded():
    cancellations = Cancellations()
    for number in range(CANCEL_LIMIT + 10):
        cancellations.add(number.to_bytes(16, "big"), 0.0, 0.0)
    assert len(cancellations.take()) == CANCEL_LIMIT


@given(st.lists(st.tuples(st.floats(0, 0.02), st.floats(0, 0.02)), min_size=1))
def test_it_is_told_at_once_where_it_is_worth_it_and_not_too_often(steps):
    """Only what has been out for long, and never twice within `EVERY_S`."""
    cancellations, now, told = Cancellations(), 0.0, []
    for number, (waited, out_for) in enumerate(steps):
        now += waited
        if cancellations.add(number.to_bytes(16, "big"), now - out_for, now):
            told.append(now)
            assert now - (now - out_for) >= WORTH_S
        elif now - (now - out_for) >= WORTH_S:
            assert now - told[-1] < EVERY_S
    assert all(later - before >= EVERY_S for before, later in pairwise(told))
