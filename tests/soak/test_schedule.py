"""The schedule of a soak: from a seed, and every kind in every round."""

from __future__ import annotations

from itertools import islice

from hypothesis import given
from hypothesis import strategies as st

from tests.soak.damage import DAMAGES
from tests.soak.schedule import KINDS, LONGEST_S, SHORTEST_S, faults


@given(st.integers())
def test_each_round_has_every_kind_once_and_a_seed_repeats_itself(seed):
    first = list(islice(faults(seed), 3 * len(KINDS)))
    assert first == list(islice(faults(seed), 3 * len(KINDS)))
    for at in range(0, len(first), len(KINDS)):
        assert sorted(f.kind for f in first[at : at + len(KINDS)]) == sorted(KINDS)
    assert all(SHORTEST_S <= fault.lasts_s <= LONGEST_S for fault in first)


def test_each_kind_can_be_done():
    assert set(DAMAGES) == set(KINDS)
