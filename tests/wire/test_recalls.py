"""What a replica is told of requests that are no longer wanted."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fogft.wire.recalls import LIMIT, Recalls

ids = st.binary(min_size=16, max_size=16)


@given(st.lists(st.tuples(st.sampled_from(["add", "answered", "take"]), st.integers(0, 5))))
def test_each_is_told_once_unless_it_was_answered(steps):
    recalls, model, told = Recalls(), [], []
    for step, number in steps:
        id = bytes([number]) * 16
        if step == "add":
            recalls.add(id)
            model += [] if id in model else [id]
        elif step == "answered":
            recalls.answered(id)
            model = [other for other in model if other != id]
        else:
            told = recalls.take()
            assert told == model
            model = []
        assert bool(recalls) == bool(model)


def test_they_are_bounded():
    recalls = Recalls()
    for number in range(LIMIT + 10):
        recalls.add(number.to_bytes(16, "big"))
    assert len(recalls.take()) == LIMIT
