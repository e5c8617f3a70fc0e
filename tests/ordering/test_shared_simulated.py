"""Whole runs of several robots that share a service: one history, whoever sequences and dies."""

from __future__ import annotations

import random

import pytest

from fogft.core.shared_orders import Vote
from fogft.core.shared_places import PLACE_BYTES, PLACE_LIMIT, Places
from fogft.core.shared_robot import AHEAD, SharedRobot
from fogft.core.shared_sequencer import SharedSequencer
from fogft.ordering import orders
from fogft.ordering.orders import START, Op
from tests.linearizability import counter, key_value
from tests.ordering.service_world import ask_counter, ask_key_value
from tests.ordering.shared_world import SharedWorld

CLIENTS = 2
ALL_KINDS = "SSRCPMXXHHG"  # see `fault`


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
    drive(world, questions, 1500, faults, kinds=ALL_KINDS)
    world.heal()
    world.settle(3000)
    world.check()


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
    world.check()


def whole(world: SharedWorld):
    """Return a condition: all at rest, and the members are the replicas that there are."""

    def holds() -> bool:
        members = {host.machine.member for host in world.hosts.values()}
        books = {frozenset(host.machine.book.members) for host in world.hosts.values()}
        return world.at_rest() and books == {frozenset(members)}

    return holds


def begun(robots: int = 2, replicas: int = 3) -> SharedWorld:
    world = SharedWorld(counter, 0, random.Random(1), robots=robots, replicas=replicas)
    assert world.settle(4000, whole(world))
    return world


def sequencer_of(world: SharedWorld) -> str:
    (name,) = [n for n, robot in world.robots.items() if robot.brain.term is not None]
    return name


def test_another_robot_goes_on_when_the_sequencer_is_lost():
    """What it had been answered is there, and what had been handed in is answered once."""
    world = begun()
    first = sequencer_of(world)
    (other,) = world.robots.keys() - {first}
    for name in (first, other):
        world.ask(name, 0, ("add", 1))
        assert world.settle(2000)
    world.ask(other, 0, ("add", 1))
    world.kill_robot(first)
    assert world.settle(4000)
    assert world.answers() == [1, 2, 3]
    assert sequencer_of(world) == other


def test_a_sequencer_without_a_majority_answers_nothing_and_another_goes_on():
    """Each robot reaches other replicas; where two are, it goes on, and nothing is lost."""
    world = begun()
    first = sequencer_of(world)
    (other,) = world.robots.keys() - {first}
    world.cut_off(first, 0)
    world.cut_off(first, 1)
    world.cut_off(other, 2)
    world.ask(first, 0, ("add", 5))
    world.ask(other, 0, ("add", 1))
    assert world.settle(3000, lambda: bool(world.history))
    world.settle(200, lambda: False)
    assert world.answers() == [1], "nobody was there to agree with the first"
    world.heal()
    assert world.settle(4000)
    assert world.answers() == [1, 6]
    assert sequencer_of(world) == other


def test_one_replica_that_both_reach_is_enough_to_be_answered_through():
    """Cut off from two of three, a robot hands in at the third, which obeys the other one."""
    world = begun()
    first = sequencer_of(world)
    world.cut_off(first, 0)
    world.cut_off(first, 1)
    world.ask(first, 0, ("add", 5))
    assert world.settle(3000)
    assert world.answers() == [5]
    assert sequencer_of(world) != first


def test_the_services_of_all_replicas_die_while_proxies_and_sequencer_live():
    """They are restored from checkpoint and log."""
    world = begun()
    for _ in range(50):
        world.ask(sequencer_of(world), 0, ("add", 1))
        assert world.settle(2000)
    for replica in world.hosts:
        world.crash_service(replica)
    world.ask(sequencer_of(world), 0, ("add", 1))
    assert world.settle(20_000)
    assert world.answers() == list(range(1, 52))


def test_a_majority_lost_at_once_is_said_and_never_answered_from_an_older_state():
    """One of three is left, and might lack what the two others had: nobody answers any more."""
    world = begun()
    world.ask("r0", 0, ("add", 5))
    assert world.settle(2000)
    world.kill_process(0)
    world.kill_process(1)
    for name in ("r0", "r1"):
        world.kill_robot(name)
        world.start_robot(name)
        world.ask(name, 0, ("get", 0))
    assert not world.settle(3000)
    assert world.answers() == [5]
    troubles = {robot.brain.trouble for robot in world.robots.values()}
    assert any("most of the 3 replicas that have the state" in trouble for trouble in troubles)


def test_new_replicas_alone_do_not_begin_anew():
    """Neither for a robot that was answered, nor for one that only saw that the service began."""
    world = begun()
    world.ask("r0", 0, ("add", 5))
    assert world.settle(2000)
    world.settle(300, lambda: False)  # all have looked
    for replica in list(world.hosts):
        world.kill_process(replica)
    for name in ("r0", "r1"):
        world.kill_robot(name)
        world.start_robot(name)
        world.ask(name, 0, ("get", 0))
    assert not world.settle(2000)
    assert world.answers() == [5]
    troubles = {robot.brain.trouble for robot in world.robots.values()}
    assert {"no replica that can be reached" in trouble for trouble in troubles} == {True}


def test_a_service_begins_only_with_all_replicas_that_the_pool_has():
    """Two of three might be all that one robot sees, and the third with others all of another."""
    world = SharedWorld(counter, 0, random.Random(1))
    for name in world.robots:
        world.cut_off(name, 2)
    world.ask("r0", 0, ("add", 1))
    assert not world.settle(500)
    assert all("2 of 3 replicas" in robot.brain.trouble for robot in world.robots.values())
    world.heal()
    assert world.settle(4000)
    assert world.answers() == [1]


def test_a_robot_that_waits_for_much_is_given_no_more_numbers():
    """Replicas keep the answers to all that a robot may still ask for."""
    brain = SharedRobot(1, lambda above: above + 1, lambda: 0.5)
    assert all(brain.submit(b"", 0.0) is not None for _ in range(AHEAD))
    assert brain.submit(b"", 0.0) is None
    brain.abandon(1)
    assert brain.submit(b"", 0.0) is not None


def test_what_lies_unanswered_at_a_replica_is_bounded():
    """Callers have given up; the links have still room for looks, and a caller of now is served."""
    places = Places()
    for seq in range(PLACE_LIMIT):
        assert places.choose([0], seq, 0) == 0
        places.begin(0, seq, 10)
    assert places.choose([0], PLACE_LIMIT, 0) is None
    assert places.choose([0, 1], PLACE_LIMIT, 0) == 1
    places.begin(1, 7, PLACE_BYTES)
    assert places.choose([0, 1], PLACE_LIMIT, 0) is None
    places.end(0, 3)
    assert places.choose([0, 1], PLACE_LIMIT, 0) == 0
    assert places.choose([0, 1], 4, 0) is None, "it lies there"
    places.end(1, 7)
    assert places.choose([0, 1], 4, 0) == 1


@pytest.mark.parametrize("seen_begun", [False, True])
def test_a_term_founds_a_service_only_with_all_listed_replicas_and_where_none_was_seen(seen_begun):
    term = SharedSequencer(orders.next_epoch(0, 1), founders=2, may_found=not seen_begun)
    term.listed = 3
    blank = [Vote(START, True, True, member, 0) for member in (7, 8, 9)]
    for reached in (2, 3):
        term.reach(range(reached), 0.0)
        for order in term.take():
            if order.op is Op.CLAIM:
                term.replied(order.replica, Op.CLAIM, order.index, blank[order.replica].encode())
        assert (term.base is not None) == (reached == 3 and not seen_begun)
    assert term.members == (() if seen_begun else (7, 8, 9))
