"""A pool's hours: when they end, and when they begin anew."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.intent import Intent
from fogft.model.reason import Cause, Reason
from fogft.planning import lifetime
from fogft.planning.observed.history import Event, EventKind, History
from tests.planning.pool_worlds import spec

TWO_HOURS = spec(max_hours=2.0)
moments = st.floats(1.0, 4e9)


@pytest.mark.parametrize(
    ("hours", "at_s", "left_s"),
    [
        (None, 9e5, 86_400.0),
        (48.0, 3600.0, 86_400.0),
        (2.0, 3600.0, 3600.0),
        (2.0, 7200.0, 0.0),
        (2.0, 1e9, 0.0),
    ],
)
def test_replicas_without_a_manager_never_outlive_the_pool(hours, at_s, left_s):
    assert lifetime.unmanaged_s(spec(max_hours=hours), 1e9, 1e9 + at_s) == left_s


@given(created=moments, now=moments)
def test_without_a_limit_a_pool_never_ends(created: float, now: float) -> None:
    """Whatever the clock says."""
    assert not lifetime.is_over(spec(), created, now)
    assert lifetime.notes(spec(), created, now) == []


@given(created=moments, hours=st.floats(0.001, 8000), later=st.floats(0, 1e6))
def test_once_over_it_stays_over_until_up(created: float, hours: float, later: float) -> None:
    """No tick after the end finds time left; `up` gives the whole time again."""
    limited = spec(max_hours=hours)
    end = lifetime.ends_at(limited, created)
    assert end is not None
    assert lifetime.is_over(limited, created, end + later)
    revived = lifetime.revived(limited, Intent(), created, end + later)
    begun_at = lifetime.begun_at(revived, created, History())
    assert not lifetime.is_over(limited, begun_at, end + later)
    assert lifetime.ends_at(limited, begun_at) == end + later + hours * 3600


def test_up_gives_no_time_to_a_pool_that_has_some() -> None:
    """Else applying a file again and again would make it run for ever."""
    assert lifetime.revived(TWO_HOURS, Intent(), 1000.0, 1000.0 + 7199) == Intent()


def test_a_larger_limit_counts_from_the_same_beginning() -> None:
    """Two hours more, not all hours anew."""
    assert lifetime.is_over(TWO_HOURS, 1000.0, 1000.0 + 3 * 3600)
    more = replace(TWO_HOURS, max_hours=4.0)
    assert lifetime.ends_at(more, 1000.0) == 1000.0 + 4 * 3600


def test_the_end_is_announced() -> None:
    """Ten minutes before, and when it has come."""
    assert lifetime.notes(TWO_HOURS, 0.0, 6599.0) == []
    assert lifetime.notes(TWO_HOURS, 0.0, 6900.0) == [Reason(Cause.ENDS_SOON, seconds=300.0)]
    assert lifetime.notes(TWO_HOURS, 0.0, 7200.0) == [Reason(Cause.MAX_HOURS, seconds=7200.0)]


@given(created=moments, set_s=st.floats(-1e7, 1e7), slept_s=st.floats(0, 1e5))
def test_setting_the_clock_takes_and_gives_no_time(created, set_s, slept_s):
    """Sleep does: the machines are paid meanwhile."""
    at = created + 60.0
    moved = [
        Event(at + set_s, EventKind.CLOCK, 0, 0, by_s=set_s),
        Event(at + set_s + slept_s, EventKind.SLEPT, 0, 0, by_s=slept_s),
    ]
    begun_at = lifetime.begun_at(Intent(), created, History(moved))
    assert begun_at == created + set_s
    end = lifetime.ends_at(TWO_HOURS, begun_at)
    assert not lifetime.is_over(TWO_HOURS, begun_at, at + set_s)
    assert end is not None
    assert lifetime.is_over(TWO_HOURS, begun_at, end)
    assert lifetime.begun_at(Intent(began_at=at + set_s + 1), created, History(moved)) in (
        at + set_s + 1,
        at + set_s + 1 + set_s,  # set back: what was asked for since cannot be told apart
    )
