"""Silence: how long nothing was answered of what was asked."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fogft.link.zenoh.robot.probing import Silence

times = st.floats(0, 1e6, allow_nan=False)


@given(steps=st.lists(st.floats(0, 10, allow_nan=False), min_size=1, max_size=20))
def test_silence_counts_from_the_first_unanswered_probe(steps: list[float]) -> None:
    """Asking again makes nobody less silent."""
    silence = Silence()
    now = 100.0
    for step in steps:
        silence.began(now)
        now += step
    assert silence.for_s(now) == now - 100.0


@given(asked=times, later=times)
def test_an_answer_ends_it(asked: float, later: float) -> None:
    """Who has answered is not silent, however long nobody asks again."""
    silence = Silence()
    silence.began(asked)
    silence.ended()
    assert silence.for_s(asked + later) == 0.0


@given(asked=times, before=st.floats(0, 5), held_up=st.floats(0, 1e4), after=st.floats(0, 5))
def test_time_in_which_we_did_not_run_is_left_out(
    asked: float, before: float, held_up: float, after: float
) -> None:
    """A robot that slept for an hour suspects nobody for it."""
    silence = Silence()
    silence.began(asked)
    woke = asked + before + held_up
    silence.excuse(held_up, woke)
    assert silence.for_s(woke + after) <= before + after + 1e-6


@given(now=times, excuse=st.floats(-10, 1e6))
def test_it_is_never_negative(now: float, excuse: float) -> None:
    """An excuse larger than the silence leaves none."""
    silence = Silence()
    silence.began(now)
    silence.excuse(excuse, now)
    assert silence.for_s(now) == 0.0
