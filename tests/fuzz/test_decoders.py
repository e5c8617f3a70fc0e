"""A short run of the fuzzer: damaged inputs by seed. The long one is `scripts/fuzz`."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.mutation import damaged
from tests.fuzz.targets import targets

TARGETS = targets()


@pytest.mark.parametrize("name", TARGETS)
def test_what_is_good_is_taken(name: str) -> None:
    """The seeds reach the inside of each decoder, or damaging them would show nothing."""
    target = TARGETS[name]
    if name != "certificate":  # a signature belongs to it
        assert all(target.run(seed) for seed in target.seeds)


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_bytes_are_taken_or_refused(name: str) -> None:
    """A thousand of each: nothing else than its own refusal ever comes out."""
    target, dice = TARGETS[name], random.Random(name)
    taken = sum(target.run(damaged(target.seeds, dice)) for _ in range(1000))
    assert taken < 1000


@pytest.mark.parametrize("name", TARGETS)
@given(data=st.binary(max_size=2000))
def test_any_bytes_are_taken_or_refused(name: str, data: bytes) -> None:
    TARGETS[name].run(data)
