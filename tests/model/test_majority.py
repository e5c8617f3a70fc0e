"""What more than half of a group is."""

from hypothesis import given
from hypothesis import strategies as st

from fogft.core.majority import is_majority

groups = st.sets(st.integers(0, 8))


@given(groups, groups, groups)
def test_two_majorities_share_a_member(some: set[int], others: set[int], members: set[int]) -> None:
    if is_majority(some, members) and is_majority(others, members):
        assert some & others & members


def test_half_is_none() -> None:
    assert is_majority({1, 2, 9}, (1, 2, 3))
    assert not is_majority({1, 2, 9}, (1, 2, 3, 4))
    assert not is_majority(set(), ())
