"""Whom the cloud is asked about, and how often."""

from __future__ import annotations

import itertools
from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from fogft.model.replica import LinkState, MachinePhase, Observed
from fogft.planning.observed.refresh import LONGEST_PAUSE_S, Silent
from tests.planning.pool_worlds import World, replica, spec, worlds


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
    """Never one that answers, is still being launched, has failed or is being shut down."""
    links = {link.id: link for link in world.links or ()}
    machines = {m.id: m for m in world.machines or ()}
    for id in Silent().due(world.observed, world.history):
        assert links[id].state is not LinkState.UP or links[id].silent_for_s > 0.5
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


def with_silence(world: World, silent_s: float, rtt_s: float | None = 0.05) -> World:
    """Return a world whose links are up, and whose last probes wait for their answers."""
    links = tuple(replace(x, silent_for_s=silent_s, rtt_s=rtt_s) for x in world.links or ())
    return replace(world, links=links)


def test_a_late_answer_is_reason_enough_to_ask_before_the_link_is_suspect() -> None:
    well = World(spec()).having(replica(0))
    assert not Silent().due(with_silence(well, 0.5).observed, well.history)
    assert len(Silent().due(with_silence(well, 0.7).observed, well.history)) == 1


def test_an_answer_is_late_only_when_the_way_is_not_that_long() -> None:
    """Over a satellite an answer takes 0.7 s, and nobody is asked about anything."""
    far = World(spec()).having(replica(0))
    assert not Silent().due(with_silence(far, 0.8, rtt_s=0.7).observed, far.history)
    assert len(Silent().due(with_silence(far, 2.2, rtt_s=0.7).observed, far.history)) == 1


def test_a_late_answer_changes_nothing_but_the_question() -> None:
    """Whoever is merely late is planned for as if nothing were."""
    well = World(spec()).having(replica(0), replica(1))
    late = with_silence(well, 1.9)
    plans = [w.plan() for w in (well, late)]
    assert plans[0].launches == plans[1].launches
    assert plans[0].terminations == plans[1].terminations == ()
    assert plans[0].draining == plans[1].draining


@given(st.binary(min_size=113, max_size=113))
def test_a_link_that_hesitates_ever_so_often_costs_few_questions(late: bytes) -> None:
    """A quarter of an hour, in which each second's answer is late or is not, bit by bit."""
    well = World(spec()).having(replica(0))
    seen = [with_silence(well, silent_s).observed for silent_s in (0.0, 0.9)]
    memory, asked = Silent(), 0
    for second in range(900):
        now = seen[late[second // 8] >> second % 8 & 1]
        asked += len(memory.due(replace(now, now=well.now + second), well.history))
    assert asked <= 5 + 900 / LONGEST_PAUSE_S


def test_who_is_lost_after_a_doubt_is_asked_about_again_at_once() -> None:
    well, silent = (World(spec()).having(replica(0, state=s)) for s in ("ready", "silent"))
    memory = Silent()
    doubted = replace(with_silence(well, 0.7).observed, now=well.now)
    assert len(memory.due(doubted, well.history)) == 1
    assert not memory.due(replace(doubted, now=well.now + 0.5), well.history)
    lost = replace(silent.observed, now=well.now + 1.4)
    assert len(memory.due(lost, silent.history)) == 1
