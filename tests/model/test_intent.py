"""What the user wants besides the file, and how long it lasts."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import FogftError, StateError
from fogft.model import intent as intents
from fogft.model.choices import ScheduleSpec, WindowSpec
from fogft.model.intent import Intent
from fogft.model.plain import from_plain, stored, to_plain
from tests.planning.pool_worlds import spec

NOON = 43_200.0  # UTC

counts = st.one_of(st.none(), st.integers(0, 16))
made = st.builds(
    Intent,
    target=counts,
    scaled_from=counts,
    drained=st.dictionaries(st.integers(0, 9), st.integers(1, 9), max_size=4),
    excluded=st.frozensets(st.sampled_from(["c", "c/r", "c/r/z"])),
    stopping=st.booleans(),
)
anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@given(made)
def test_json_round_trip(intent: Intent) -> None:
    """What is written is what is read."""
    assert from_plain(Intent, to_plain(intent)) == intent


@given(made, st.sampled_from(sorted(to_plain(Intent()))), anything)
def test_garbage_is_an_error_or_a_valid_intent(intent: Intent, key: str, junk: object) -> None:
    """A damaged file raises StateError and nothing else."""
    try:
        read = stored(Intent, {**to_plain(intent), key: junk}, "not an intent")
    except StateError:
        return
    assert from_plain(Intent, to_plain(read)) == read


@given(st.integers(1, 8), st.lists(st.sampled_from([-2, -1, 1, 2]), max_size=10))
def test_scale_adds_up_within_bounds(replicas: int, changes: list[int]) -> None:
    """Each change counts from what is wanted now; one that cannot be is refused whole."""
    intent, wanted = Intent(), replicas
    for change in changes:
        try:
            intent = intents.scale(intent, spec(replicas), change, NOON)
        except FogftError:
            assert not 1 <= wanted + change <= 16
        else:
            wanted += change
        assert intent.wanted(spec(replicas), NOON) == wanted


def test_within_a_window_scale_counts_from_what_runs_and_back_to_the_window_is_the_files():
    """`scale up` never ends a replica, `scale down` never launches one."""
    window = WindowSpec(frozenset(range(7)), 0, 86_400, 3, None)
    pool = spec(1, schedule=ScheduleSpec("UTC", (window,)))
    more = intents.scale(Intent(), pool, 1, NOON)
    assert more.wanted(pool, NOON) == 4
    fewer = intents.scale(more, pool, -3, NOON)
    assert fewer.wanted(pool, NOON) == 1, "though the file says so"
    assert intents.scale(fewer, pool, 2, NOON) == Intent()


def test_scale_stays_until_the_files_own_number_changes() -> None:
    """Editing anything else keeps it; another `replicas` ends it for good."""
    intent = intents.scale(Intent(), spec(2), 3, NOON)
    edited = intents.file_changed(intent, spec(2), spec(2, task={"run": "other"}))
    assert edited.wanted(spec(2), NOON) == 5
    changed = intents.file_changed(edited, spec(2), spec(4))
    assert changed.wanted(spec(4), NOON) == 4
    assert intents.file_changed(changed, spec(4), spec(2)).wanted(spec(2), NOON) == 2


def test_scale_gives_way_even_if_nobody_told_it_of_the_change() -> None:
    """The number that it was scaled from must still stand in the file."""
    assert intents.scale(Intent(), spec(2), 3, NOON).wanted(spec(4), NOON) == 4


def test_scale_below_one_is_refused_with_a_hint() -> None:
    """A pool without replicas is what `down` is for."""
    with pytest.raises(FogftError, match="the minimum is 1") as caught:
        intents.scale(Intent(), spec(2), -2, NOON)
    assert "fogft down" in caught.value.hint


def test_drain_covers_what_runs_and_not_what_follows() -> None:
    """The generation drained and those before; never the replacement. Repeating is harmless."""
    intent = intents.drain(Intent(), 2, 3)
    assert intent.drained == {2: 3}
    assert intents.drain(intents.drain(intent, 2, 1), 2, 3) == intent


def test_exclude_and_include() -> None:
    """A location covers what lies in it, by whole names; including needs an exclusion."""
    intent = intents.exclude(Intent(), "/aws/us-west-1/")
    assert intent.is_excluded("aws/us-west-1/a")
    assert not intent.is_excluded("aws/us-west-10/a")
    assert intents.include(intent, "aws/us-west-1") == Intent()
    with pytest.raises(FogftError) as caught:
        intents.include(intent, "aws")
    assert caught.value.hint == "excluded now: `aws/us-west-1`"


@pytest.mark.parametrize("text", ["", "a b", "a/b/c/d", "//", "a//b"])
def test_what_is_no_location_is_refused(text: str) -> None:
    """The error shows how one is written."""
    with pytest.raises(FogftError, match="not a location"):
        intents.exclude(Intent(), text)


def test_stopping_wants_nothing_and_up_revives() -> None:
    """`down` wants none; a later `up` of the file takes that back."""
    stopping = replace(Intent(), stopping=True)
    assert stopping.wanted(spec(2), NOON) == 0
    assert intents.file_changed(stopping, spec(2), spec(2)).wanted(spec(2), NOON) == 2
