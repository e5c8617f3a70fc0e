"""Wrong prices, no prices and clocks that jump: said clearly, and nothing is launched for them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.reason import Cause, Reason
from fogft.model.replica import LinkReport, LinkState
from tests.planning.pool_worlds import OFFERS, World, applied, elapsed, replica, serving, spec

YEAR_S = 366 * 86_400.0


@pytest.mark.parametrize("price", [-0.1, -math.inf, math.nan, math.inf])
def test_impossible_prices_launch_nothing_and_are_told(price):
    wrong = tuple(replace(offer, usd_per_hour=price) for offer in OFFERS)
    planned = World(spec(2), offers=wrong).plan()
    assert not planned.launches
    assert Reason(Cause.IMPOSSIBLE_PRICE, location="east/one/a") in planned.notes
    assert any(Reason(Cause.IMPOSSIBLE_PRICE) in note.because for note in planned.notes)


def test_an_empty_catalogue_launches_nothing_and_is_told():
    planned = World(spec(2), offers=()).plan()
    assert not planned.launches
    assert any(Reason(Cause.NOTHING_OFFERED) in note.because for note in planned.notes)


def settled(count: int) -> World:
    world = World(spec(count))
    for _ in range(4):
        world = elapsed(applied(world, world.plan()), 30.0)
    assert len(serving(world)) == count
    return world


@given(st.integers(1, 4), st.floats(-YEAR_S, YEAR_S))
def test_a_clock_that_jumps_moves_nobody_in_a_whole_pool(count, jump_s):
    """Forth or back by up to a year: no launch, no ending, no mark, then or at the next look."""
    world = settled(count)
    for _ in range(2):
        world = replace(world, now=world.now + jump_s)
        planned = world.plan()
        assert not planned.launches
        assert not planned.terminations
        assert not planned.draining


@given(st.integers(1, 4), st.floats(-YEAR_S, -1.0))
def test_a_clock_that_jumps_back_ends_no_launch_under_way(count, jump_s):
    """What was launched in the future is young, not late."""
    world = World(spec(count))
    world = applied(world, world.plan())
    planned = replace(world, now=world.now + jump_s).plan()
    assert not planned.launches
    assert not planned.terminations


@given(st.floats(-YEAR_S, YEAR_S))
def test_a_clock_that_jumps_costs_at_most_one_launch_for_each_one_lost(jump_s):
    """A loss remembered from the future, or from long ago, keeps nobody from being replaced."""
    world = World(spec(2)).having(replica(0), replica(1, state="failed"))
    world = replace(world, now=world.now + jump_s)
    assert len(world.plan().launches) <= 1


def test_a_link_of_a_replica_that_nobody_knows_does_nothing():
    stranger = replica(7, 3)
    link = LinkReport(stranger.machine.id, LinkState.UP, frozenset({"/plan"}))
    world = settled(2)
    planned = replace(world, links=(*(world.links or ()), link)).plan()
    assert not planned.launches
    assert not planned.terminations
