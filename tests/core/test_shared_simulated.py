"""Whole runs of several robots that share a service: one history, whoever sequences and dies."""

from __future__ import annotations

import random

import pytest

from fogft.core import lag, ordered_term
from tests.core.shared_world import SharedWorld
from tests.core.test_ordering_simulated import ask_counter, ask_key_value
from tests.linearizability import counter, key_value, linearizable

CLIENTS = 2


def drive(world: SharedWorld, questions, steps: int, faults: float, kinds: str) -> None:
    """Let chance choose what happens next."""
    source = world.source
    for _ in range(steps):
        world.now += 0.0005
        chance = source.random()
        working = world.working()
        if chance < faults:
            fault(world, source.choice(kinds))
        elif chance < faults + 0.04:
            name = source.choice(sorted(world.robots))
            free = sorted(set(range(CLIENTS)) - world.busy(name))
            if free:
                world.ask(name, source.choice(free), questions(source))
        elif chance < faults + 0.2 and working:
            world.work(source.choice(working))
        elif world.letters and chance < 0.97:
            at = min(int(source.expovariate(0.7)), len(world.letters) - 1)
            kind = source.random()
            if kind < 0.01:
                world.lose(at)
            else:
                world.deliver(at, keep=kind < 0.05)
        else:
            world.tick(source.random() * 0.2)


def fault(world: SharedWorld, kind: str) -> None:
    """S: the sequencer. R: a robot. C: a service. P: a server proxy. M: a machine. X: a cut."""
    source = world.source
    robots, replicas = sorted(world.robots), sorted(world.hosts)
    if kind == "S":
        robots = [name for name in robots if world.robots[name].brain.term is not None]
    if kind in "SR" and robots:
        name = source.choice(robots)
        world.kill_robot(name)
        world.start_robot(name)
    elif kind == "C":
        world.crash_service(source.choice(replicas))
    elif kind == "P":
        world.kill_process(source.choice(replicas))
    elif kind == "M":
        world.remove_replica(source.choice(replicas))
        world.add_replica()
    elif kind == "X":
        world.cut_off(source.choice(robots), source.choice(replicas))
    elif kind == "H":
        world.heal()
    elif kind == "G":
        world.give_up(source.choice(robots), source.randrange(CLIENTS))


def check(world: SharedWorld, step, start) -> None:
    world.finish()
    answered = [call for call in world.history if call.answered]
    assert linearizable(world.history, step, start), [*map(str, answered)]
    if world.at_rest():
        states = {(repr(h.state), repr(h.applied)) for h in world.hosts.values()}
        assert len(states) == 1


@pytest.fixture(params=["wide", "narrow"])
def limits(request, monkeypatch) -> None:
    """With narrow limits replicas fall too far behind all the time."""
    if request.param == "narrow":
        monkeypatch.setattr(lag, "LIMIT", 3)
        monkeypatch.setattr(ordered_term, "WINDOW", 2)


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize(
    ("questions", "step", "start"),
    [(ask_counter, counter, 0), (ask_key_value, key_value, ())],
    ids=["counter", "key_value"],
)
def test_histories_are_linearizable_under_faults(seed, questions, step, start):
    """Whatever dies, is cut off, lost, repeated or reordered: callers see one service."""
    source = random.Random(seed)
    world = SharedWorld(
        step, start, source, robots=source.randint(2, 3), replicas=source.choice([3, 3, 5]),
        log_entries=source.choice([8, 64]),
    )  # fmt: skip
    world.settle(2000)
    faults = source.choice([0.0, 0.003, 0.01])
    drive(world, questions, 1500, faults, kinds="SSRCPMXXHHG")
    world.heal()
    world.settle(3000)
    check(world, step, start)


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("seed", range(12))
def test_while_a_majority_lives_all_recover_and_agree(seed):
    """One loss after the other, of whatever kind: all is answered, and every replica catches up."""
    source = random.Random(seed)
    world = SharedWorld(counter, 0, source, robots=2, log_entries=16)
    assert world.settle(4000)
    for _ in range(8):
        drive(world, ask_counter, 60, faults=0.0, kinds="")
        fault(world, source.choice("SRCPM"))
        drive(world, ask_counter, 60, faults=0.0, kinds="")
        assert world.settle(8000, whole(world)), "somebody never caught up"
    lost = sum(not call.answered for call in world.history)
    assert lost <= world.killed
    check(world, counter, 0)


def whole(world: SharedWorld):
    """Return a condition: all at rest, and the members are the replicas that there are."""

    def holds() -> bool:
        members = {host.machine.member for host in world.hosts.values()}
        books = {frozenset(host.machine.book.members) for host in world.hosts.values()}
        return world.at_rest() and books == {frozenset(members)}

    return holds
