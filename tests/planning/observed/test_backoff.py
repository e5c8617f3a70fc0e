"""How long a location rests: more with each failure, never for ever, forgiven in time."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fogft.model.reason import Cause, Reason
from fogft.planning.observed.backoff import (
    BASE_S,
    EAGER_S,
    EVERYWHERE,
    FORGIVE_S,
    LIMIT_S,
    NO_ROOM_S,
    backing_off,
    backoff,
    lost_lately,
    next_change,
    recently_failed,
)
from fogft.planning.observed.history import Event, EventKind, Failure, History

PLACE, OTHER = "c/r/a", "c/r/b"


def refused(at: float, generation: int, cause: Cause = Cause.CAPACITY) -> list[Event]:
    return [
        Event(at, EventKind.LAUNCH, 0, generation, PLACE),
        Event(at, EventKind.REFUSED, 0, generation, "", Reason(cause)),
    ]


@given(st.lists(st.floats(0, 3000), min_size=1, max_size=30), st.floats(3000, 10_000))
def test_rest_is_bounded_and_forgiven(times: list[float], now: float) -> None:
    """No rest is longer than the limit, and none outlives forgiveness."""
    rest = backoff([Failure(at, Cause.CAPACITY) for at in times], now)
    if rest is not None:
        assert now < rest.until <= max(times) + LIMIT_S
    assert backoff([Failure(at, Cause.CAPACITY) for at in times], max(times) + FORGIVE_S) is None


@given(st.integers(1, 40), st.sampled_from([Cause.ERROR, Cause.CAPACITY]))
def test_rest_doubles_up_to_the_limit(count: int, cause: Cause) -> None:
    """n failures in a row rest for a base times 2 ** (n - 1), at most LIMIT_S."""
    base_s = {Cause.ERROR: BASE_S, Cause.CAPACITY: NO_ROOM_S}[cause]
    rest = backoff([Failure(float(i), cause) for i in range(count)], count - 0.5)
    assert rest is not None
    assert rest.until == count - 1 + min(base_s * 2 ** (count - 1), LIMIT_S)
    assert rest.failures == count


def test_a_success_wipes_the_slate_clean() -> None:
    """A replica that became ready there ends the row of failures."""
    events = [*refused(0, 1), *refused(1, 2), *refused(2, 3)]
    assert PLACE in backing_off(History(events), 3)
    ready = [Event(2, EventKind.LAUNCH, 1, 1, PLACE), Event(3, EventKind.READY, 1, 1)]
    assert PLACE not in backing_off(History([*events, *ready]), 4)


def test_quota_rests_as_long_as_possible() -> None:
    """A full account does not get better by asking again soon."""
    rest = backing_off(History(refused(0, 1, Cause.QUOTA)), 1)[PLACE]
    assert (rest.until, rest.cause) == (LIMIT_S, Cause.QUOTA)


def test_early_death_counts_and_a_late_one_does_not() -> None:
    """Dying within a minute of readiness speaks against the place; preemption later is life."""
    for died_at, counts in ((30.0, True), (3000.0, False)):
        events = [
            Event(0, EventKind.LAUNCH, 0, 1, PLACE),
            Event(5, EventKind.READY, 0, 1),
            Event(died_at, EventKind.GONE, 0, 1),
        ]
        assert (PLACE in backing_off(History(events), died_at + 1)) is counts


def test_failed_setup_is_held_against_the_file_not_the_place() -> None:
    """A broken `setup` stops launches everywhere for a while, until one becomes ready."""
    events = [
        Event(0, EventKind.LAUNCH, 0, 1, PLACE),
        Event(9, EventKind.FAILED, 0, 1, "", Reason(Cause.SETUP)),
    ]
    found = backing_off(History(events), 10)
    assert set(found) == {EVERYWHERE}
    assert EVERYWHERE not in backing_off(History(events), 9 + BASE_S)


def test_an_ended_replica_is_no_failure() -> None:
    """What we ended ourselves says nothing about the place."""
    events = [
        Event(0, EventKind.LAUNCH, 0, 1, PLACE),
        Event(1, EventKind.ENDING, 0, 1),
        Event(2, EventKind.ENDED, 0, 1),
    ]
    assert not backing_off(History(events), 3)
    assert OTHER not in backing_off(History(events), 3)


HAPPENINGS = st.lists(
    st.tuples(
        st.sampled_from([Cause.CAPACITY, Cause.QUOTA, Cause.SETUP, "ready", "gone", "look"]),
        st.sampled_from([PLACE, OTHER]),
        st.booleans(),
        st.sampled_from([0, 1, 5, 60, 299, 600, 3599, 3600, 14_400]) | st.integers(-9_000, 9_000),
    ),
    max_size=25,
)


@given(HAPPENINGS)
def test_what_is_remembered_of_places_is_what_follows_from_all_events(happenings):
    """However often it was asked before, in whatever order, and with a clock that jumps back."""
    events: list[Event] = []
    now, asked = 100_000.0, History()
    for generation, (what, place, on_demand, later_s) in enumerate(happenings, 1):
        now += later_s
        happened = [Event(now, EventKind.LAUNCH, 0, generation, place, on_demand=on_demand)]
        if what == "look":
            happened = []
        elif what in ("ready", "gone"):
            happened.append(Event(now, EventKind(what), 0, generation))
        else:
            happened.append(Event(now, EventKind.REFUSED, 0, generation, "", Reason(what)))
        events += happened
        for event in happened:
            asked.add(event)
        anew = History(events)
        for question in (backing_off, recently_failed):
            assert question(asked, now) == question(anew, now)


def test_who_waits_looks_again_where_one_was_lost() -> None:
    """A stand-in returns there as soon as it may; who waits for nothing does not look at all."""
    lost = History(
        [
            Event(0, EventKind.LAUNCH, 0, 1, PLACE),
            Event(10, EventKind.READY, 0, 1),
            Event(1000, EventKind.GONE, 0, 1),
        ]
    )
    assert [lost_lately(lost, at) for at in (999, 1120)] == [{}, {}]
    assert lost_lately(lost, 1001) == {PLACE: 1000 + NO_ROOM_S}
    assert next_change(lost, 1001, waits=True, restless=False) == 1000 + NO_ROOM_S
    assert next_change(lost, 1001, waits=False, restless=True) == 1000 + NO_ROOM_S
    assert next_change(lost, 1001, waits=False, restless=False) == float("inf")


def test_who_waits_looks_again_when_a_rest_ends_or_all_rest_for_long_enough() -> None:
    """Whichever comes first: a rest for want of room is longer than the minute."""
    events = [e for n in range(1, 9) for e in refused(n, n)]
    launch = Event(0, EventKind.LAUNCH, 0, 1, PLACE)
    few = History([launch, Event(1, EventKind.FAILED, 0, 1, "", Reason(Cause.ERROR))])
    many = History(events)
    assert next_change(few, 2, waits=True, restless=False) == 1 + BASE_S
    assert next_change(many, 9, waits=True, restless=False) == 8 + EAGER_S
    assert next_change(many, 9, waits=False, restless=True) == 8 + FORGIVE_S
