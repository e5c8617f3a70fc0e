"""How often spot machines are lost at a place, learned from the history."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.reason import Cause, Reason
from fogft.planning.observed.hazard import (
    EVERY_S,
    HALF_LIFE_S,
    PRIOR_LOSSES,
    PRIOR_S,
    REFUSED,
    UNKNOWN,
    as_of,
    hazards,
    penalty,
)
from fogft.planning.observed.history import Event, EventKind, History

HOUR_S = 3600.0
NOW = as_of(1_700_000_000.0)
PLACE, OTHER = "c/r/a", "c/r/b"


def life(
    began_h: float, lasted_h: float | None, *, end: EventKind = EventKind.GONE, n: int = 1
) -> list[Event]:
    """A spot machine at `PLACE` that was launched so many hours ago, and lasted so long."""
    began = NOW - began_h * HOUR_S
    events = [Event(began, EventKind.LAUNCH, 0, n, PLACE), Event(began + 60, EventKind.READY, 0, n)]
    if lasted_h is not None:
        events.append(Event(began + lasted_h * HOUR_S, end, 0, n))
    return events


def rate(*events: Event, now: float = NOW) -> float:
    return hazards(History(sorted(events, key=lambda event: event.at)), now)[PLACE]


def lived_s(from_h: float, to_h: float) -> float:
    """What hours of life weigh, added up minute by minute."""
    minutes = range(round(from_h * 60), round(to_h * 60), -1)
    return sum(60.0 * 0.5 ** ((minute - 0.5) * 60 / HALF_LIFE_S) for minute in minutes)


def test_of_a_place_that_was_never_asked_nothing_is_learned():
    assert hazards(History(), NOW) == {}
    assert pytest.approx(0.25) == UNKNOWN


def test_a_loss_counts_in_full_at_once_and_by_half_a_day_later():
    lasted = life(2, 1)
    expected = (PRIOR_LOSSES + 0.5 ** (1 / 24)) / (PRIOR_S + lived_s(2, 1)) * HOUR_S
    assert rate(*lasted) == pytest.approx(expected, rel=1e-3)
    later = (PRIOR_LOSSES + 0.5 ** (25 / 24)) / (PRIOR_S + lived_s(26, 25)) * HOUR_S
    assert rate(*lasted, now=NOW + 24 * HOUR_S) == pytest.approx(later, rel=1e-3)


@pytest.mark.parametrize("end", [EventKind.ENDED, None])
def test_a_life_without_a_loss_speaks_for_its_place(end):
    """Whether it was ended as asked, or goes on."""
    found = rate(*life(8, 4 if end else None, end=end or EventKind.ENDED))
    expected = PRIOR_LOSSES / (PRIOR_S + lived_s(8, 4 if end else 0)) * HOUR_S
    assert found == pytest.approx(expected, rel=1e-3)
    assert found < UNKNOWN


def test_a_refusal_for_lack_of_room_counts_for_a_part_of_a_loss_and_another_for_nothing():
    for cause, counts in ((Cause.CAPACITY, REFUSED), (Cause.QUOTA, 0.0)):
        refused = [
            Event(NOW, EventKind.LAUNCH, 1, 1, PLACE),
            Event(NOW, EventKind.REFUSED, 1, 1, PLACE, Reason(cause)),
        ]
        assert rate(*refused) == pytest.approx((PRIOR_LOSSES + counts) / PRIOR_S * HOUR_S)


def test_on_demand_machines_say_nothing_of_spot_ones():
    launched = Event(NOW - HOUR_S, EventKind.LAUNCH, 100, 1, OTHER, on_demand=True)
    assert OTHER not in hazards(History([launched, *life(2, 1)]), NOW)


def test_it_does_not_depend_on_who_asks_when_within_half_an_hour():
    """What happened since is counted all the same: then all who ask see it."""
    events = life(3, None)
    history = History(events)
    first = hazards(history, NOW + 1)
    assert hazards(history, NOW + EVERY_S - 1) == first
    assert hazards(history, NOW + EVERY_S) != first
    assert as_of(NOW + EVERY_S - 1) == NOW
    assert as_of(NOW + EVERY_S) == NOW + EVERY_S


@given(st.lists(st.tuples(st.floats(0.1, 60), st.floats(0.05, 40)), max_size=6))
def test_a_loss_more_is_never_better_and_never_worse_than_all_at_once(lives):
    """Whatever was lost before, however long it had lived."""
    ended = [
        event for n, one in enumerate(lives, 2) for event in life(*one, n=n) if event.at <= NOW
    ]
    fresh = life(0.05, 0.05)
    without = hazards(History(sorted(ended, key=lambda event: event.at)), NOW).get(PLACE, UNKNOWN)
    found = rate(*ended, *fresh)
    assert found > without * 0.98
    assert found <= (PRIOR_LOSSES + len(lives) + 1) / PRIOR_S * HOUR_S


def test_a_penalty_is_what_a_loss_adds_to_a_price_in_the_scores_terms():
    assert penalty(0.0) == 0.0
    assert penalty(1.0) == pytest.approx(math.log(2.0)), "one an hour doubles the price"
    assert penalty(0.25) < penalty(0.5)
