"""The order of the tests themselves."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tests.dealing import dealt


@given(
    st.lists(st.tuples(st.sampled_from([0, 0, 0, 120, 240]), st.booleans()), max_size=60),
    st.integers(1, 6),
)
def test_no_test_is_lost_or_run_twice(tests: list[tuple[int, bool]], workers: int) -> None:
    order = dealt(range(len(tests)), lambda i: tests[i][0], lambda i: tests[i][1], workers)
    assert sorted(order) == list(range(len(tests)))


def test_all_blocks_but_the_last_begin_with_their_share_of_the_long_ones() -> None:
    """What waits is in the last one, what computes is not; all stay beside their neighbours."""
    limits = dict.fromkeys("abcdefghi", 0) | {"long": 120, "longer": 180, "longest": 240}
    assert dealt(list(limits), limits.__getitem__, set("cdg").__contains__, 3) == [
        *("longest", "long", "c", "d"),
        *("longer", "g", "a", "b"),
        *("e", "f", "h", "i"),
    ]
