"""The checker of linearizability, on histories known to be right and known to be wrong."""

from __future__ import annotations

import itertools
import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.nightly import by_day
from tests.ordering.linearizability import Call, counter, key_value, linearizable

ADD = ("add", 1)
GET = ("get", 0)
PUT1, PUT2, READ = ("put", "k", 1), ("put", "k", 2), ("get", "k")

RIGHT = {
    "empty": [],
    "one after the other": [Call(0, ADD, 1, 1), Call(2, GET, 3, 1)],
    "two at once, in either order": [Call(0, ADD, 3, 2), Call(1, ADD, 2, 1)],
    "read during a write sees the old": [Call(0, ADD, 3, 1), Call(1, GET, 2, 0)],
    "read during a write sees the new": [Call(0, ADD, 3, 1), Call(1, GET, 2, 1)],
    "unanswered, and it took effect": [Call(0, ADD), Call(5, GET, 6, 1)],
    "unanswered, and it did not": [Call(0, ADD), Call(5, GET, 6, 0)],
    "unanswered, and it took effect late": [
        Call(0, ADD),
        Call(1, GET, 2, 0),
        Call(3, GET, 4, 1),
    ],
}
WRONG = {
    "stale read": [Call(0, ADD, 1, 1), Call(2, GET, 3, 0)],
    "lost update": [Call(0, ADD, 1, 1), Call(2, ADD, 3, 1)],
    "applied twice": [Call(0, ADD, 1, 1), Call(2, GET, 3, 2)],
    "both are first": [Call(0, ADD, 3, 1), Call(1, ADD, 2, 1)],
    "answer from nowhere": [Call(0, GET, 1, 7)],
    "seen before it was asked": [Call(0, GET, 1, 1), Call(2, ADD, 3, 1)],
    "reads go back": [Call(0, ADD, 9, 1), Call(1, GET, 2, 1), Call(3, GET, 4, 0)],
    "unanswered, seen, then gone": [Call(0, ADD), Call(1, GET, 2, 1), Call(3, GET, 4, 0)],
}


@pytest.mark.parametrize("name", RIGHT)
def test_right_histories_are_accepted(name):
    assert linearizable(RIGHT[name], counter, 0)


@pytest.mark.parametrize("name", WRONG)
def test_wrong_histories_are_refused(name):
    assert not linearizable(WRONG[name], counter, 0)


def test_key_value_histories():
    """Two writes at once, then reads: they agree on who was last, or the history is wrong."""
    writes = [Call(0, PUT1, 5, -1), Call(1, PUT2, 4, 1)]
    assert linearizable([*writes, Call(6, READ, 7, 2)], key_value, ())
    assert not linearizable([*writes, Call(6, READ, 7, 1)], key_value, ())
    both = [Call(0, PUT1), Call(1, PUT2)]
    reads = [Call(6, READ, 7, 1), Call(8, READ, 9, 2), Call(10, READ, 11, 1)]
    assert linearizable([*both, *reads[:2]], key_value, ())
    assert not linearizable([*both, *reads], key_value, ())


calls = st.lists(
    st.tuples(
        st.integers(0, 8), st.integers(0, 8), st.sampled_from([ADD, GET]), st.integers(-1, 3)
    ),
    max_size=5,
)


@given(calls)
def test_agrees_with_trying_every_order(drawn):
    """On small histories the answer is that of a search without any cleverness."""
    history = [
        Call(began, asked, began + took + 0.5 if answer >= 0 else math.inf, answer)
        for began, took, asked, answer in drawn
    ]
    assert linearizable(history, counter, 0) == _by_force(history)


def _by_force(history):
    answered = [c for c in history if c.answered]
    pending = [c for c in history if not c.answered]
    for count in range(len(pending) + 1):
        for chosen in itertools.combinations(pending, count):
            if any(map(_explains, itertools.permutations([*answered, *chosen]))):
                return True
    return False


def _explains(order):
    state = 0
    for i, call in enumerate(order):
        if any(later.ended < call.began for later in order[i + 1 :]):
            return False
        state, answer = counter(state, call.asked)
        if call.answered and answer != call.answer:
            return False
    return True


@pytest.mark.parametrize("seed", range(by_day(8, at_night=200)))
def test_a_real_lock_is_linearizable_and_one_changed_answer_is_not(seed):
    """A long history of a serial service passes; with one answer off by one it does not."""
    source = random.Random(seed)
    state, history = 0, []
    for i in range(200):
        asked = (ADD, GET)[source.random() < 0.3]
        state, answer = counter(state, asked)
        history.append(Call(i - source.random() * 3, asked, i + source.random() * 3, answer))
    assert linearizable(history, counter, 0)
    bad = source.randrange(len(history))
    wrong = Call(
        history[bad].began, history[bad].asked, history[bad].ended, history[bad].answer + 500
    )
    assert not linearizable([*history[:bad], wrong, *history[bad + 1 :]], counter, 0)
