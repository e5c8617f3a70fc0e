"""A pool's hours: when they end, and when they begin anew."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from fogft.core import lifetime
from fogft.core.intent import Intent
from tests.core.pool_worlds import spec

TWO_HOURS = spec(max_hours=2.0)
moments = st.floats(1.0, 4e9)


@given(created=moments, now=moments)
def test_without_a_limit_a_pool_never_ends(created: float, now: float) -> None:
    """Whatever the clock says."""
    assert not lifetime.is_over(spec(), Intent(), created, now)
    assert lifetime.notes(spec(), Intent(), created, now) == []


@given(created=moments, hours=st.floats(0.001, 8000), later=st.floats(0, 1e6))
def test_once_over_it_stays_over_until_up(created: float, hours: float, later: float) -> None:
    """No tick after the end finds time left; `up` gives the whole time again."""
    limited = spec(max_hours=hours)
    end = lifetime.ends_at(limited, Intent(), created)
    assert end is not None
    assert lifetime.is_over(limited, Intent(), created, end + later)
    revived = lifetime.revived(limited, Intent(), created, end + later)
    assert not lifetime.is_over(limited, revived, created, end + later)
    assert lifetime.ends_at(limited, revived, created) == end + later + hours * 3600


def test_up_gives_no_time_to_a_pool_that_has_some() -> None:
    """Else applying a file again and again would make it run for ever."""
    assert lifetime.revived(TWO_HOURS, Intent(), 1000.0, 1000.0 + 7199) == Intent()


def test_a_larger_limit_counts_from_the_same_beginning() -> None:
    """Two hours more, not all hours anew."""
    assert lifetime.is_over(TWO_HOURS, Intent(), 1000.0, 1000.0 + 3 * 3600)
    more = replace(TWO_HOURS, max_hours=4.0)
    assert lifetime.ends_at(more, Intent(), 1000.0) == 1000.0 + 4 * 3600


def test_the_end_is_announced() -> None:
    """Ten minutes before, and when it has come."""
    assert lifetime.notes(TWO_HOURS, Intent(), 0.0, 6599.0) == []
    assert lifetime.notes(TWO_HOURS, Intent(), 0.0, 6900.0) == [
        "the pool ends by itself in 5 min (`max_hours`)"
    ]
    assert lifetime.notes(TWO_HOURS, Intent(), 0.0, 7200.0) == [
        "its 2 hours (`max_hours`) are over: the pool ends by itself"
    ]
