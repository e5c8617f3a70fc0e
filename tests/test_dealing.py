"""The order of the tests themselves."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tests.dealing import dealt


@given(
    st.lists(
        st.tuples(st.sampled_from([0, 0, 0, 120, 240]), st.sampled_from([0, 5, 9]), st.booleans()),
        max_size=60,
    ),
    st.integers(1, 7),
)
def test_no_test_is_lost_or_run_twice(tests: list[tuple[int, int, bool]], workers: int) -> None:
    limit_s, takes_s, computes = (lambda i, n=n: tests[i][n] for n in range(3))
    order = dealt(range(len(tests)), limit_s, takes_s, computes, workers)
    assert sorted(order) == list(range(len(tests)))


def test_all_blocks_but_the_last_begin_with_their_share_of_the_long_ones() -> None:
    """What waits is in the last one, what computes is not; all stay beside their neighbours.

    What is known to take long is before its like.
    """
    limits = dict.fromkeys("abcdefghi", 0) | {"long": 120, "longer": 180, "longest": 120}
    takes = {"longest": 40.0, "h": 5.0}
    order = dealt(
        list(limits), limits.__getitem__, lambda t: takes.get(t, 0.0), set("cdg").__contains__, 3
    )
    assert order == [
        *("longest", "long", "c", "d"),
        *("longer", "g", "h", "a"),
        *("b", "e", "f", "i"),
    ]
