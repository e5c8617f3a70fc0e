"""The schedule of a soak: from a seed, every kind in every round; and what fails a soak."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.soak.damage import DAMAGES
from tests.soak.schedule import KINDS, LONGEST_S, SHORTEST_S, faults
from tests.soak.verdict import Outcome, faults_found


@given(st.integers())
def test_each_round_has_every_kind_once_and_a_seed_repeats_itself(seed):
    first = list(islice(faults(seed), 3 * len(KINDS)))
    assert first == list(islice(faults(seed), 3 * len(KINDS)))
    for at in range(0, len(first), len(KINDS)):
        assert sorted(f.kind for f in first[at : at + len(KINDS)]) == sorted(KINDS)
    assert all(SHORTEST_S <= fault.lasts_s <= LONGEST_S for fault in first)


def test_each_kind_can_be_done():
    assert set(DAMAGES) == set(KINDS)


GOOD = Outcome(100, 100, (), 0, (), 100, dict.fromkeys(KINDS, 1))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"right": 99}, "failed: 1"),
        ({"right": 99, "wrong": [7]}, "wrong: [7]"),
        ({"silent": 1}, "unanswered in time: 1"),
        ({"twice": ["ran.0: 5 2 times"]}, "run twice: ['ran.0: 5 2 times']"),
        ({"ran": 99}, "answered and noted by no server proxy: 1"),
        ({"done": dict.fromkeys(KINDS[1:], 1)}, "never done: kill"),
        ({"trouble": "ada is not whole again"}, "ada is not whole again"),
        ({"asked": 0, "right": 0, "ran": 0}, "no request was asked"),
    ],
)
def test_any_failure_fails_a_soak(change, why):
    assert faults_found(GOOD, KINDS) == []
    assert why in faults_found(replace(GOOD, **change), KINDS)


def test_the_faults_are_those_that_a_pool_has_to_bear():
    assert len(KINDS) == 16
    assert {"all killed", "suspend", "no descriptors"} <= set(KINDS)
    assert {"kill", "freeze", "blackhole", "slow", "starve", "address change"} <= set(KINDS)
    assert {"rendezvous death", "gateway death"} <= set(KINDS)
    assert {"uplink loss", "new uplink address", "certificate rotation"} <= set(KINDS)
    assert {"clock set", "long suspend"} <= set(KINDS)
