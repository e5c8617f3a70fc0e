"""Windows by the clock on the wall, with the launch ahead of them."""

from __future__ import annotations

import datetime
import zoneinfo

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.choices import ScheduleSpec, WindowSpec
from fogft.model.schedule import Wish, next_change, window_at, wish, zone
from tests.planning.pool_worlds import spec

HOUR = 3600
PACIFIC = "America/Los_Angeles"
WORK = WindowSpec(frozenset(range(5)), 8 * HOUR, 18 * HOUR, 4, 3.0)
NIGHT = WindowSpec(frozenset({4}), 22 * HOUR, 6 * HOUR, 1, 0.5)
SCHEDULE = ScheduleSpec(PACIFIC, (WORK, NIGHT), prelaunch_s=600)
USUAL = Wish(2, 1.0)


def wished(schedule, now: float, usual: Wish = USUAL) -> Wish:
    cap = usual.max_usd_per_hour
    return wish(spec(usual.replicas, schedule=schedule, max_usd_per_hour=cap), now)


def at(day: str, clock: str, tz: str = PACIFIC) -> float:
    local = datetime.datetime.fromisoformat(f"{day}T{clock}")
    return local.replace(tzinfo=zoneinfo.ZoneInfo(tz)).timestamp()


@pytest.mark.parametrize(
    ("day", "clock", "replicas", "cap", "ahead"),
    [
        ("2024-06-03", "07:49:59", 2, 1.0, False),  # a Monday
        ("2024-06-03", "07:50:00", 4, 3.0, True),
        ("2024-06-03", "08:00:00", 4, 3.0, False),
        ("2024-06-03", "17:59:59", 4, 3.0, False),
        ("2024-06-03", "18:00:00", 2, 1.0, False),
        ("2024-06-08", "12:00:00", 2, 1.0, False),  # a Saturday
        ("2024-06-07", "23:00:00", 1, 0.5, False),  # Friday night, which lasts
        ("2024-06-08", "05:49:59", 1, 0.5, False),  # into Saturday
        ("2024-06-08", "05:59:59", 2, 1.0, True),  # the usual number is more: launched ahead too
        ("2024-06-09", "05:00:00", 2, 1.0, False),
        # Nobody launches ahead for a window that wants fewer.
        ("2024-06-07", "21:55:00", 2, 1.0, False),
    ],
)
def test_what_is_wanted_when(day, clock, replicas, cap, ahead):
    assert wished(SCHEDULE, at(day, clock)) == Wish(replicas, cap, ahead)


@pytest.mark.parametrize("day", ["2024-03-11", "2024-11-04"])  # after both changes of the clocks
def test_a_window_follows_daylight_saving_time(day):
    assert window_at(SCHEDULE, at(day, "08:00")) is WORK
    assert window_at(SCHEDULE, at(day, "07:59:59")) is None


def test_a_lower_cap_ahead_does_not_hold_yet():
    """Ahead of a window the higher of both caps holds: what runs is not to be ended for it."""
    thrifty = WindowSpec(frozenset(range(7)), 8 * HOUR, 18 * HOUR, 4, 0.5)
    schedule = ScheduleSpec("UTC", (thrifty,), prelaunch_s=600)
    assert wished(schedule, at("2024-06-03", "07:55", "UTC")) == Wish(4, 1.0, True)
    assert wished(schedule, at("2024-06-03", "07:55", "UTC"), Wish(2, None)) == Wish(4, None, True)


windows = st.builds(
    WindowSpec,
    st.frozensets(st.integers(0, 6), min_size=1),
    st.integers(0, 23).map(lambda h: h * HOUR),
    st.integers(1, 24).map(lambda h: h * HOUR),
    st.none() | st.integers(0, 8),
    st.none() | st.floats(0.1, 5),
).filter(lambda w: w.begins_s != w.ends_s)


@given(
    st.lists(windows, min_size=1, max_size=4),
    st.floats(1.7e9, 1.71e9),
    st.sampled_from([0.0, 300.0, 3600.0]),
)
def test_a_pool_is_asked_for_before_its_window_opens(found, now, prelaunch_s):
    """What a window wants is wanted already `prelaunch_s` before any of its moments."""
    schedule = ScheduleSpec("Europe/Berlin", tuple(found), prelaunch_s)
    later = window_at(schedule, now + prelaunch_s)
    wanted = USUAL.replicas if later is None or later.replicas is None else later.replicas
    assert wished(schedule, now).replicas >= wanted


@given(
    st.sampled_from([0, 1, 5]),
    st.sampled_from(["UTC", PACIFIC]),
    st.integers(0, 6 * 24 * 60),
    st.sampled_from([0.0, 600.0, 3600.0]),
)
def test_nothing_changes_before_the_next_change(replicas, tz, minute, prelaunch_s):
    """Nor where a window wants fewer than what follows it, which is then launched ahead."""
    window = WindowSpec(frozenset(range(7)), 20 * HOUR, 6 * HOUR, replicas, None)
    schedule = ScheduleSpec(tz, (window,), prelaunch_s)
    now = at("2024-06-03", "00:00:00", tz) + 60 * minute
    told = wished(schedule, now)
    moment = now
    while moment + 60 < next_change(schedule, now):
        moment += 60
        assert wished(schedule, moment) == told


def test_an_unknown_zone_is_an_error():
    with pytest.raises(ValueError, match="Mars/Olympus"):
        zone("Mars/Olympus")
