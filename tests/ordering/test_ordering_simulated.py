"""Whole runs of sequencer and replicas, by seed: histories are linearizable, states agree."""

from __future__ import annotations

import random

import pytest

from fogft.model.refusal import Refusal
from fogft.ordering import orders, peer
from fogft.ordering.catching_up import WINDOW
from fogft.ordering.orders import Op, Promise
from fogft.ordering.sequencer import Sequencer
from tests.nightly import by_day
from tests.ordering.linearizability import Call, counter, key_value, linearizable
from tests.ordering.ordering_world import World
from tests.ordering.service_world import ask_counter, ask_key_value, lost

CLIENTS = 3


def drive(world: World, source: random.Random, questions, steps: int, faults: float) -> None:
    """Let chance choose what happens next."""
    for _ in range(steps):
        world.now += 0.001
        chance = source.random()
        working = world.working()
        if chance < faults:
            fault(world, source)
        elif chance < faults + 0.15:
            free = sorted(set(range(CLIENTS)) - world.busy())
            if free:
                world.ask(source.choice(free), questions(source))
        elif chance < faults + 0.4 and working:
            world.work(source.choice(working))
        elif world.letters and chance < 0.95:
            at = min(int(source.expovariate(0.7)), len(world.letters) - 1)
            kind = source.random()
            if kind < 0.03:
                world.lose(at)
            else:
                world.deliver(at, keep=kind < 0.08)
        else:
            world.tick(source.random() * 0.3)


def fault(world: World, source: random.Random) -> None:
    replicas = sorted(world.hosts)
    kind = source.random()
    if kind < 0.25:
        world.new_term()
    elif kind < 0.55:
        world.crash_service(source.choice(replicas))
    elif kind < 0.75 and len(replicas) > 1:
        world.remove_replica(source.choice(replicas))
    elif kind < 0.95 and len(replicas) < 4:
        world.add_replica()
    else:
        world.give_up(source.randrange(CLIENTS))


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("seed", [*range(by_day(10, at_night=400)), 20223])
@pytest.mark.parametrize(
    ("questions", "step", "start"),
    [(ask_counter, counter, 0), (ask_key_value, key_value, ())],
    ids=["counter", "key_value"],
)
def test_histories_are_linearizable_under_faults(seed, questions, step, start):
    """Whatever is lost, repeated, reordered or killed, callers see one service in one order."""
    source = random.Random(seed)
    world = World(step, start, replicas=source.randint(1, 3), log_entries=source.choice([4, 16]))
    drive(world, source, questions, 400, faults=source.choice([0.0, 0.01, 0.05]))
    world.settle()
    world.check()


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("seed", [*range(by_day(8, at_night=250)), 10622])
def test_without_losing_every_copy_all_recover_and_agree(seed):
    """While one replica and its service stay, all others come to its state and all is answered."""
    source = random.Random(seed)
    world = World(counter, 0, log_entries=8)
    for _ in range(12):
        drive(world, source, ask_counter, 40, faults=0.0)
        kind = source.randrange(4)
        others = sorted(world.hosts)[1:]
        if kind == 0:
            world.new_term()
        elif kind == 1 and others:
            world.crash_service(source.choice(others))
        elif kind == 2 and others:
            world.remove_replica(source.choice(others))
        else:
            world.add_replica()
        world.settle()
        assert world.at_rest(), "somebody never caught up"
    world.check()


def test_all_replicas_lost_while_the_proxy_lives_loses_nothing():
    """New replicas are restored from checkpoint and log; the sum goes on."""
    world = World(counter, 0, log_entries=8)
    for _ in range(30):
        world.ask(0, ("add", 1))
        world.tick()
        world.settle()
    for replica in list(world.hosts):
        world.remove_replica(replica)
    world.ask(0, ("add", 1))
    world.add_replica()
    world.settle()
    assert [call.answer for call in world.history] == list(range(1, 32))
    assert world.restored == 1


@pytest.mark.parametrize("calls", [0, 3])
def test_all_replicas_lost_after_a_new_proxy_that_was_not_called_loses_nothing(calls):
    """A term that nobody has called in yet has a checkpoint, too: what it began from."""
    world = World(counter, 0)
    world.settle()
    for _ in range(calls):
        world.ask(0, ("add", 1))
        world.settle()
    world.new_term()
    world.settle()
    world.new_term()  # replicas have joined a term, and so are no longer where they began
    for _ in range(20):
        world.tick()
        world.settle()
    for replica in list(world.hosts):
        world.remove_replica(replica)
    world.add_replica()
    world.ask(0, ("add", 1))
    world.settle(500)
    assert world.answers() == list(range(1, calls + 2))


def test_proxy_and_all_replicas_lost_is_said_and_never_answered_from_an_older_state():
    """Nobody holds the answered state any more: requests stay unanswered, `stranded` says why."""
    world = World(counter, 0)
    world.ask(0, ("add", 5))
    world.settle()
    for replica in list(world.hosts):
        world.remove_replica(replica)
    world.add_replica()
    world.new_term()
    world.ask(0, ("get", 0))
    world.settle(500)
    assert world.answers() == [5]
    assert world.sequencer.stranded


def test_a_proxy_killed_after_an_answer_does_not_go_back_behind_it():
    """Only one replica had applied the answered request: the next term waits for that one."""
    world = World(counter, 0, replicas=2)
    world.settle()
    world.ask(0, ("add", 5))
    for letter in list(world.letters):
        if letter.sent.order.replica == 1:
            world.letters.remove(letter)
            world.end(letter.sent, None, lost(letter.sent))
    world.deliver(0)
    world.work(0)
    while not world.history:
        world.deliver(0)
    assert world.history[0].answer == 5
    world.letters.clear()
    world.new_term()
    world.ask(0, ("get", 0))
    world.settle()
    assert world.history[-1].answer == 5
    assert world.hosts[1].state == 5


def test_the_newest_replica_dies_during_its_restore():
    """A replica that is killed while it takes the snapshot holds nobody up."""
    world = World(counter, 0, replicas=1, log_entries=4)
    for _ in range(9):
        world.ask(0, ("add", 1))
        world.tick()
        world.settle()
    newest = world.add_replica()
    while world.hosts[newest].work is None:
        working = [r for r, host in world.hosts.items() if host.work and r != newest]
        if working:
            world.work(working[0])
        elif world.letters:
            world.deliver(0)
        else:
            world.tick()
    world.crash_service(newest)
    world.ask(0, ("add", 1))
    world.settle()
    assert world.history[-1].answer == 10
    assert world.at_rest()
    again = world.add_replica()
    world.remove_replica(newest)
    world.ask(0, ("add", 1))
    world.settle()
    assert world.hosts[again].state == world.history[-1].answer == 11


class Poisoned(World):
    """The question `kill` ends the services of some replicas; an empty one nobody can read."""

    kills = frozenset({0, 1, 2})
    deaths = 0

    def work(self, replica: int) -> None:
        host = self.hosts[replica]
        begun = host.work
        question = self.questions.get(begun.payload) if begun.op is Op.APPLY else None
        if question == ("kill", 0) and replica in self.kills:
            self.deaths += 1
            self.crash_service(replica)
        elif begun.op is Op.APPLY and question is None:
            host.work = None
            self.effects(host, host.machine.done(begun.serial, None))
        else:
            super().work(replica)

    def step_of(self, replica: int):
        return lambda state, asked: counter(state, ("add", 10) if asked[0] == "kill" else asked)


@pytest.mark.parametrize("replicas", [1, 3])
def test_a_request_over_which_every_service_dies_ends_without_effect(replicas):
    """Else each would die again as it is brought up to date, for ever."""
    world = Poisoned(counter, 0, replicas=replicas)
    world.settle()
    for question in (("add", 1), ("add", 1), ("kill", 0), ("add", 1), ("add", 1)):
        world.ask(0, question)
    world.settle(3000)
    assert world.answers() == [1, 2, 3, 4]
    assert world.deaths == max(2, replicas)
    assert {host.state for host in world.hosts.values()} == {4}


@pytest.mark.parametrize("reason", [Refusal.MALFORMED, Refusal.FORGOTTEN])
def test_one_of_which_a_replica_has_no_answer_but_the_effect_keeps_it_though_that_leaves(reason):
    sequencer = Sequencer(1 << 32)
    sequencer.reach({1, 2}, 0.0)

    def brought_up(now):
        sequencer.tick(now)
        for order in sequencer.take():
            if order.op is Op.CLAIM:
                said = orders.encode_promise(Promise(orders.START, True))
                sequencer.replied(order.replica, order.op, order.index, said)
            elif order.op is Op.JOIN:
                sequencer.replied(order.replica, order.op, order.index, orders.encode_index(1))

    for now in (1.0, 2.0):
        brought_up(now)
    number = sequencer.submit(b"question")
    assert {order.replica for order in sequencer.take()} == {1, 2}
    sequencer.refused(2, Op.APPLY, number, reason, 4.0)
    sequencer.reach({1}, 4.0)
    for now in (5.0, 10.0, 15.0):
        assert not sequencer.refused(1, Op.APPLY, number, Refusal.CRASHED, now)
        for later in (1.0, 2.0):
            brought_up(now + later)
    assert sequencer.log.get(number) == b"question"


def test_one_that_a_replica_out_of_reach_may_have_applied_keeps_its_effect():
    world = Poisoned(counter, 0, replicas=2)
    world.kills = frozenset({1})
    world.settle()
    world.ask(0, ("kill", 0))
    while world.working() != [0, 1]:
        world.deliver(0)
    world.work(0)
    gone = world.hosts.pop(0)  # with its answer on the way
    for letter in list(world.letters):
        if letter.sent.order.replica == 0:
            world.end(letter.sent, None, lost(letter.sent))
    world.letters = []
    world.reach()
    world.settle(1000)
    assert world.deaths > 10
    assert world.sequencer.log.get(1)
    world.hosts[0], world.kills = gone, frozenset()
    world.reach()
    world.ask(0, ("add", 1))
    world.settle(3000)
    assert world.answers() == [11]
    assert {host.state for host in world.hosts.values()} == {11}


def test_a_request_that_somebody_has_applied_keeps_its_effect_whatever_it_does_to_others():
    """Its answer is out, then its replica is out of reach, and all others die over it."""
    world = Poisoned(counter, 0)
    world.kills = frozenset({1, 2})
    world.settle()
    world.ask(0, ("kill", 0))
    while 0 not in world.working():
        world.deliver(0)
    world.work(0)
    while not world.answers():
        world.deliver(next(n for n, one in enumerate(world.letters) if not one.to_replica))
    gone = world.hosts.pop(0)
    world.reach()
    world.settle(1000)
    assert world.deaths > 10
    world.hosts[0], world.kills = gone, frozenset()
    world.reach()
    world.ask(0, ("add", 1))
    world.settle(3000)
    assert world.answers() == [10, 11]
    assert {host.state for host in world.hosts.values()} == {11}


def busy_world(requests: int) -> World:
    world = World(counter, 0, replicas=1, log_entries=4000)
    world.settle()
    for _ in range(requests):
        world.ask(0, ("add", 1))
        world.settle()
    return world


def test_a_new_replica_gets_a_fresh_snapshot_rather_than_hundreds_of_requests():
    """The log would do, and the checkpoint too; both would keep it from being ready for long."""
    world = busy_world(peer.LAG_LIMIT + 10)
    newest = world.add_replica()
    world.settle()
    assert world.restored == 1
    assert not world.hosts[newest].machine.kept, "it has applied a request itself"
    assert world.hosts[newest].machine.current


def test_a_replica_is_current_only_when_it_has_caught_up_with_the_time_of_its_joining():
    """It has joined, and still has requests to apply that were answered before it came."""
    world = busy_world(20)
    newest = world.add_replica()
    machine = world.hosts[newest].machine
    while not machine.joined:
        world.deliver(0) if world.letters else world.tick()
    for _ in range(20):
        assert not machine.current
        while world.hosts[newest].work is None:
            world.deliver(0) if world.letters else world.tick()
        world.work(newest)
    assert machine.current


def deliver_in_order(world: World) -> None:
    while world.letters:
        world.letters.append(world.letters.pop(0))
        world.deliver(-1)


@pytest.mark.parametrize("slower", [2, 4, 10])
def test_a_slow_replica_does_not_fall_ever_further_behind(slower):
    """Callers go at the pace of the fast one; when it dies, they wait for what the other lacks."""
    world = World(counter, 0, replicas=2, log_entries=8000)
    world.settle()
    fast, slow = world.hosts
    worst = 0
    for asked in range(1, 4001):
        world.ask(0, ("add", 1))
        while world.letters or world.hosts[fast].work is not None:
            if world.hosts[fast].work is not None:
                world.work(fast)
            deliver_in_order(world)
        if asked % slower == 0 and world.hosts[slow].work is not None:
            world.work(slow)
        world.tick(0.01)
        worst = max(worst, asked - world.hosts[slow].machine.position.index)
    assert len(world.history) == 4000
    most = peer.LAG_LIMIT + (slower + 1) * WINDOW + peer.RESTORE_LONGEST_S / 0.01
    assert peer.LAG_LIMIT < worst < most
    world.remove_replica(fast)
    world.ask(0, ("add", 1))
    for _ in range(worst + WINDOW):
        deliver_in_order(world)
        if world.hosts[slow].work is not None:
            world.work(slow)
        world.tick()
    assert world.history[-1].answer == 4001


def test_the_checker_would_notice():
    """The runs prove something: one answer of a real run, changed, is found to be wrong."""
    source = random.Random(5)
    world = World(counter, 0)
    drive(world, source, ask_counter, 400, faults=0.0)
    world.settle()
    last = max((c for c in world.history if c.answered), key=lambda c: c.ended)
    wrong = Call(last.began, last.asked, last.ended, last.answer - 1)
    assert not linearizable([*(c for c in world.history if c is not last), wrong], counter, 0)
