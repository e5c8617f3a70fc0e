"""Whom the cloud is asked about, and how often."""

from __future__ import annotations

import itertools
from dataclasses import replace

from hypothesis import given

from fogft.core.model import LinkState, MachinePhase, Observed
from fogft.core.refreshing import LONGEST_PAUSE_S, Silent
from tests.core.pool_worlds import World, replica, spec, worlds


def times_asked(world: World, seconds: int) -> list[int]:
    """Return after how many seconds each question came, when nothing changes."""
    silent = Silent()
    out = []
    for second in range(seconds):
        observed = replace(world.observed, now=world.now + second)
        out += [second for _ in silent.due(observed, world.history)]
    return out


@given(worlds())
def test_only_who_should_answer_and_does_not_is_asked_about(world: World) -> None:
    """Never one that answers, is still being launched, has failed or is being ended."""
    links = {link.id: link.state for link in world.links or ()}
    machines = {m.id: m for m in world.machines or ()}
    for id in Silent().due(world.observed, world.history):
        assert links[id] is not LinkState.UP
        assert machines[id].phase is MachinePhase.RUNNING
        assert id not in world.ending


def test_who_was_heard_is_asked_about_at_once_then_less_and_less_often() -> None:
    world = World(spec()).having(replica(0, state="silent", silent_s=3.0))
    asked = times_asked(world, 400)
    pauses = [b - a for a, b in itertools.pairwise(asked)]
    assert asked[0] == 0
    assert pauses == sorted(pauses)
    assert pauses[-1] == LONGEST_PAUSE_S


def test_who_was_never_heard_is_asked_about_later() -> None:
    world = World(spec()).having(replica(0, state="starting", age_s=5.0))
    assert times_asked(world, 100)[0] == 30


def test_who_answers_again_is_asked_about_at_once_the_next_time() -> None:
    """An old silence does not slow down the next question."""
    silent, well = (World(spec()).having(replica(0, state=s)) for s in ("silent", "ready"))
    memory = Silent()
    for second in range(40):
        memory.due(replace(silent.observed, now=silent.now + second), silent.history)
    assert not memory.due(replace(well.observed, now=well.now + 41), well.history)
    again: Observed = replace(silent.observed, now=silent.now + 42)
    assert len(memory.due(again, silent.history)) == 1
