"""The order of the tests themselves."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tests.dealing import dealt


@given(st.lists(st.sampled_from([0, 0, 0, 120, 240]), max_size=60), st.integers(1, 6))
def test_no_test_is_lost_or_run_twice(limits: list[int], workers: int) -> None:
    order = dealt(range(len(limits)), limits.__getitem__, workers)
    assert sorted(order) == list(range(len(limits)))


def test_each_block_begins_with_its_share_of_the_long_ones() -> None:
    """And all else stays beside its neighbours."""
    limits = {"a": 0, "b": 0, "c": 0, "d": 0, "long": 120, "longest": 240, "e": 0, "f": 0}
    assert dealt(list(limits), limits.__getitem__, 2) == [
        *("long", "a", "b", "c"),
        *("longest", "d", "e", "f"),
    ]
