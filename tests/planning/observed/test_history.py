"""Events in, facts out; and compaction that loses nothing a decision needs."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.plain import from_plain, to_plain
from fogft.model.reason import Cause, Reason
from fogft.planning.observed.history import (
    OF_NO_REPLICA,
    TOLD_ONLY,
    Event,
    EventKind,
    History,
    compacted,
)

events = st.lists(
    st.builds(
        Event,
        st.floats(0, 200_000),
        st.sampled_from(sorted(set(EventKind) - OF_NO_REPLICA)),
        st.integers(0, 3),
        st.integers(1, 4),
        st.sampled_from(["", "c/r/a", "c/r/b"]),
        st.sampled_from([None, Reason(Cause.CAPACITY, words="full")]),
        st.booleans(),
    ),
    max_size=40,
).map(lambda found: sorted(found, key=lambda e: e.at))


@given(events)
def test_event_json_round_trip(found: list[Event]) -> None:
    """What is written is what is read."""
    assert [from_plain(Event, to_plain(event)) for event in found] == found


@pytest.mark.parametrize(
    "junk", [None, 3, "x", [], {}, {"at": 1, "kind": "party", "slot": 0, "generation": 1}]
)
def test_what_is_no_event_is_an_error(junk: object) -> None:
    """Damage is told, not guessed at."""
    with pytest.raises(ValueError):
        from_plain(Event, junk)


def test_an_event_whose_cause_only_a_newer_fogft_knows_is_kept() -> None:
    """Without a launch its generation would be used again."""
    told = {"at": 1, "kind": "launch", "slot": 0, "generation": 7, "reason": {"cause": "new"}}
    assert from_plain(Event, told).reason == Reason(Cause.TROUBLE)
    with pytest.raises(ValueError):
        from_plain(Event, {**told, "reason": {"cause": 3}})


@given(events)
def test_generations_never_go_back(found: list[Event]) -> None:
    """The highest generation of a slot only grows as events come in."""
    history = History()
    for event in found:
        before = history.generations[event.slot]
        history.add(event)
        assert history.generations[event.slot] == max(before, event.generation)


@given(events)
def test_compaction_keeps_what_decides(found: list[Event]) -> None:
    """Generations, open launches, and what happened lately are the same afterwards."""
    now = 200_000.0
    before, after = History(found), History(compacted(found, now))
    assert dict(after.generations) == dict(before.generations)
    opened = {(r.slot, r.generation, r.ending) for r in before.open()}
    assert {(r.slot, r.generation, r.ending) for r in after.open()} == opened
    for record in before.open():
        kept = after.record(record.slot, record.generation)
        assert kept is not None
        assert kept.first_ready_at == record.first_ready_at
        assert kept.draining_since == record.draining_since


@given(events)
def test_compaction_twice_is_once(found: list[Event]) -> None:
    """Compacting what is compact changes nothing."""
    once = compacted(found, 200_000.0)
    assert compacted(once, 200_000.0) == once


def test_a_flapping_service_does_not_fill_the_disk() -> None:
    """Of a thousand comings and goings the first and the last two stay."""
    flaps = [
        Event(float(i), EventKind.READY if i % 2 else EventKind.UNREADY, 0, 1)
        for i in range(1, 1001)
    ]
    found = [Event(0, EventKind.LAUNCH, 0, 1, "c/r/a"), *flaps]
    kept = compacted(found, 1001)
    assert len(kept) == 4
    record = History(kept).record(0, 1)
    assert record is not None
    assert (record.first_ready_at, record.unready_since) == (1.0, 1000.0)


def test_what_is_only_told_decides_nothing_and_goes_after_a_day() -> None:
    """Updates and replaced client proxies are of no replica; the first launch stays what it was."""
    told = [Event(at, kind, 0, 0) for at, kind in enumerate(TOLD_ONLY)]
    found = [*told, Event(5, EventKind.LAUNCH, 0, 1, "c/r/a"), *told]
    history = History(found)
    assert [(r.slot, r.generation) for r in history.open()] == [(0, 1)]
    assert dict(history.generations) == {0: 1}
    assert compacted(found, 100.0) == found
    assert compacted(found, 100_000.0) == [found[len(told)]]


def test_a_listed_machine_thought_gone_is_open_again() -> None:
    """A second launch event of an id reopens it, and keeps that it was ready."""
    history = History(
        [
            Event(0, EventKind.LAUNCH, 0, 1, "c/r/a"),
            Event(1, EventKind.READY, 0, 1),
            Event(2, EventKind.GONE, 0, 1),
            Event(3, EventKind.LAUNCH, 0, 1, "c/r/a"),
        ]
    )
    [record] = history.open()
    assert (record.closed, record.first_ready_at) == (None, 1)
