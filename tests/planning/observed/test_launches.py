"""A version that never serves is given up, and no fault launches without an end."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fogft.model.reason import Cause, Reason
from fogft.planning.observed.history import Event, EventKind, History, compacted
from fogft.planning.observed.launches import (
    GIVE_UP_AFTER,
    HOUR_S,
    given_up,
    next_change,
    within_an_hour,
)

NOT_READY = Reason(Cause.TIMEOUT, because=(Reason(Cause.NOT_READY, seconds=900.0),))
NOT_RUNNING = Reason(Cause.TIMEOUT, because=(Reason(Cause.NOT_RUNNING, seconds=900.0),))
SETUP = Reason(Cause.SETUP, words="exit 1")
VERSION = "aaaa"


def launched(
    at: float, slot: int, generation: int, *ends: Event, version: str = VERSION
) -> list[Event]:
    order = Event(at, EventKind.LAUNCH, slot, generation, "c/r/a", version=version)
    return [order, *ends]


def failed(
    at: float, slot: int, generation: int, why: Reason, version: str = VERSION
) -> list[Event]:
    fault = Event(at + 1.0, EventKind.FAILED, slot, generation, reason=why)
    return launched(at, slot, generation, fault, version=version)


def test_two_launches_of_one_slot_that_fail_for_the_versions_own_reason_are_enough():
    history = History(failed(0.0, 0, 1, SETUP) + failed(10.0, 1, 1, NOT_READY))
    assert given_up(history, VERSION, 0.0) is None, "each slot has had one"
    for event in failed(20.0, 1, 2, NOT_READY):
        history.add(event)
    found = given_up(history, VERSION, -1.0)
    assert found is not None
    assert (found.cause, found.count, found.because) == (Cause.NEVER_READY, 3, (NOT_READY,))
    assert given_up(history, "bbbb", -1.0) is None, "another file is another matter"
    assert given_up(history, VERSION, 15.0) is None, "the user has asked again since"


reasons = st.sampled_from(
    [SETUP, NOT_READY, NOT_RUNNING, Reason(Cause.CAPACITY), Reason(Cause.ERROR)]
)


@given(st.lists(st.tuples(st.integers(0, 2), reasons), max_size=20))
def test_what_a_cloud_does_gives_no_version_up(what: list[tuple[int, Reason]]):
    """Only launches that failed for the version's own reasons count, slot by slot."""
    events = [e for n, (slot, why) in enumerate(what) for e in failed(float(n), slot, n + 1, why)]
    own = [slot for slot, why in what if why in (SETUP, NOT_READY)]
    expected = any(own.count(slot) >= GIVE_UP_AFTER for slot in own)
    assert (given_up(History(events), VERSION, -1.0) is not None) == expected


@given(st.lists(st.tuples(st.integers(0, 2), reasons), max_size=20), st.integers(0, 20))
def test_a_version_that_was_ready_once_is_never_given_up(what: list[tuple[int, Reason]], at: int):
    events = [e for n, (slot, why) in enumerate(what) for e in failed(float(n), slot, n + 1, why)]
    served = launched(0.5, 3, 1, Event(0.6, EventKind.READY, 3, 1))
    history = History([*events[: 2 * at], *served, *events[2 * at :]])
    assert given_up(history, VERSION, -1.0) is None


@given(st.lists(st.tuples(st.integers(0, 2), reasons, st.booleans()), max_size=20))
def test_what_was_given_up_outlives_the_compaction_of_days(what):
    """A manager that runs for weeks remembers it, and also what was once ready."""
    events = []
    for n, (slot, why, served) in enumerate(what):
        events += failed(float(n), slot, n + 1, why, version=f"v{n % 2}")
        if served:
            events += launched(n + 0.5, 3, n + 1, Event(n + 0.6, EventKind.READY, 3, n + 1))
            events.append(Event(n + 0.7, EventKind.ENDED, 3, n + 1))
        events.append(Event(n + 1.5, EventKind.ENDED, slot, n + 1))
    later = History(compacted(events, 30 * 86_400.0))
    for version in ("v0", "v1", VERSION):
        before = given_up(History(events), version, -1.0)
        after = given_up(later, version, -1.0)
        assert (before is None) == (after is None)
        assert (version in later.ready_versions) == (version in History(events).ready_versions)


@given(st.lists(st.floats(0.0, 3 * HOUR_S), max_size=30), st.floats(0.0, 4 * HOUR_S))
def test_the_launches_of_the_last_hour_are_counted(times: list[float], now: float):
    times = sorted(t for t in times if t <= now)
    history = History([e for n, at in enumerate(times) for e in launched(at, 0, n + 1)])
    found = [record.launched_at for record in within_an_hour(history, now, 0.0, on_demand=False)]
    assert found == [at for at in times if now - at < HOUR_S]
    assert within_an_hour(history, now, 0.0, on_demand=True) == []
    assert within_an_hour(history, now, now - 60.0, on_demand=False) == [
        record
        for record in within_an_hour(history, now, 0.0, on_demand=False)
        if record.launched_at >= now - 60.0
    ]
    assert next_change(history, now) == min((at + HOUR_S for at in found), default=float("inf"))


def test_a_launch_that_came_to_no_machine_does_not_count():
    """At once, or after the cloud had looked for a place."""
    full = Reason(Cause.CAPACITY)
    refused = launched(0.0, 0, 1, Event(0.1, EventKind.REFUSED, 0, 1, reason=full))
    late = failed(1.0, 0, 2, full)
    history = History(refused + late + failed(2.0, 0, 3, NOT_READY))
    assert [r.generation for r in within_an_hour(history, 5.0, 0.0, on_demand=False)] == [3]
