"""When the clock was set, and when the machine slept: told apart, and no time is lost or won."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fogft.model.choices import ScheduleSpec, WindowSpec
from fogft.model.intent import Intent
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Observed
from fogft.planning.observed.backoff import backing_off, recently_failed
from fogft.planning.observed.clock_jumps import DOUBT_S, LEAST_S, Jump, Reading, Watch
from fogft.planning.observed.history import Event, EventKind, History, compacted
from fogft.planning.sizing import Inputs, size
from tests.planning.pool_worlds import spec

PLACE = "c/r/a"
gained = st.floats(LEAST_S + 1, 1e8) | st.floats(-1e8, -LEAST_S - 1)


def looked(*readings: tuple[float, float, float]) -> list[Jump | None]:
    watch = Watch()
    return [watch.look(Reading(*reading)) for reading in readings]


@given(st.floats(1e8, 2e9), st.floats(0, 1e7), st.integers(0, 10_000))
def test_time_that_passes_is_no_jump(wall_s, awake_s, passed_s):
    """Nor is a manager that was held up, however long."""
    later = (wall_s + passed_s, awake_s + passed_s, awake_s + passed_s)
    assert looked((wall_s, awake_s, awake_s), later) == [None, None]


@given(gained, st.integers(0, 100))
def test_a_clock_that_is_set_is_told_to_the_second(set_s, passed_s):
    _, jump = looked((1e9, 50.0, 50.0), (1e9 + passed_s + set_s, 50.0 + passed_s, 50.0 + passed_s))
    assert jump is not None
    assert abs(jump.set_s - set_s) < 1e-3
    assert jump.slept_s == 0.0
    assert jump.reason == Reason(Cause.CLOCK_SET, seconds=jump.set_s)


@given(st.floats(LEAST_S + 1, 1e6), st.one_of(st.just(0.0), gained))
def test_sleep_is_told_apart_from_a_clock_that_is_set(slept_s, set_s):
    _, jump = looked((1e9, 50.0, 60.0), (1e9 + 1 + slept_s + set_s, 51.0, 61.0 + slept_s))
    assert jump is not None
    assert abs(jump.slept_s - slept_s) < 1e-3
    assert abs(jump.set_s - set_s) < 1e-3


def test_a_clock_that_was_set_is_in_doubt_for_a_minute():
    """And one that is set back at once was never anything else."""
    watch = Watch()
    watch.look(Reading(1e9, 0.0, 0.0))
    watch.look(Reading(1e9 + 3601.0, 1.0, 1.0))
    assert watch.doubt_s == 3600.0
    watch.look(Reading(1e9 + 11.0, 11.0, 11.0))
    assert watch.doubt_s == 0.0
    watch.look(Reading(1e9 + 10.0 + DOUBT_S, 10.0 + DOUBT_S, 10.0 + DOUBT_S))
    watch.look(Reading(1e9 + 11.0 + DOUBT_S, 11.0 + DOUBT_S, 11.0 + DOUBT_S))
    assert watch.doubt_s == 0.0


HAPPENINGS = st.lists(
    st.tuples(
        st.sampled_from([EventKind.READY, EventKind.UNREADY, EventKind.GONE, EventKind.REFUSED]),
        st.integers(0, 600),
        st.sampled_from([0, 0, 0, -86_400, -60, 60, 3600, 86_400]),
    ),
    max_size=20,
)


@given(HAPPENINGS)
def test_all_that_is_remembered_keeps_its_distance_from_now(happenings):
    """Records, rests, avoidance: as if the clock had always been right. Compaction as well."""
    right, told = [], []
    now, ahead_s = 100_000.0, 0.0
    for generation, (kind, later_s, set_s) in enumerate(happenings, 1):
        now += later_s
        ahead_s += set_s
        if set_s:
            told.append(Event(now + ahead_s, EventKind.CLOCK, 0, 0, by_s=float(set_s)))
        for what, why in ((EventKind.LAUNCH, None), (kind, Reason(Cause.CAPACITY))):
            right.append(Event(now, what, 0, generation, PLACE, why))
            told.append(Event(now + ahead_s, what, 0, generation, PLACE, why))
    true, moved = History(right), History(told)
    assert _ages(moved, now + ahead_s) == _ages(true, now)
    kept = compacted(told, now + ahead_s)
    assert _ages(History(kept), now + ahead_s) == _ages(History(compacted(right, now)), now)


def _ages(history: History, now: float) -> object:
    records = [
        (r.generation, now - r.launched_at, r.first_ready_at and now - r.first_ready_at)
        for r in history.open()
    ]
    rests = {
        place: (now - rest.until, rest.failures)
        for question in (backing_off, recently_failed)
        for place, rest in question(history, now).items()
    }
    return records, rests


def test_a_schedule_waits_for_a_clock_that_was_just_set():
    """For a minute the time of day goes without what the clock gained."""
    night = WindowSpec(frozenset(range(7)), 20 * 3600, 22 * 3600, replicas=4)
    pool = spec(1, schedule=ScheduleSpec("UTC", (night,), prelaunch_s=0.0))
    noon, evening = 12 * 3600.0, 21 * 3600.0
    wanted = [
        size(Inputs(pool, Intent(), Observed(now, (), doubt_s=doubt_s), History())).total
        for now, doubt_s in ((noon, 0.0), (evening, evening - noon), (evening, 0.0))
    ]
    assert wanted == [1, 1, 4]
