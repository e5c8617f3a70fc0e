"""Updates of a stateful service: one version answers, until at one point of the order another does.

Both versions are counters. The new one adds everything twice, so that it shows in every later
answer which version computed which step.
"""

from __future__ import annotations

import random

import pytest

from fogft.ordering.active_version import VACANCY_S, ActiveVersion
from fogft.ordering.sequencer import Sequencer
from tests.nightly import by_day
from tests.ordering.linearizability import counter
from tests.ordering.ordering_world import World
from tests.ordering.service_world import ask_counter
from tests.ordering.test_ordering_simulated import drive

FACTORS = {"old": 1, "new": 2}


class Versions(World):
    """A world whose replicas have versions, and whose update is driven as a manager does."""

    def __init__(self, old: int) -> None:
        self.version_of: dict[int, str] = {}
        self.draining: set[int] = set()
        self.said: list[tuple[int, str, object, int]] = []  # index, version, question, answer
        self.holder: str | None = None
        super().__init__(counter, 0, replicas=0)
        for _ in range(old):
            self.add("old")

    def add(self, version: str) -> int:
        self.version_of[self.next_replica] = version
        return self.add_replica()

    def leave(self, replica: int) -> None:
        self.draining.add(replica)
        self.reach()

    def step_of(self, replica):
        def step(state, question):
            kind, value = question
            return counter(state, (kind, value * FACTORS[self.version_of[replica]]))

        return step

    def accepted(self, order, payload):
        version = self.version_of[order.replica]
        self.holder = version
        asked = self.pending.get(order.index)
        question = asked.asked if asked is not None else None
        self.said.append((order.index, version, question, eval(payload.decode())))

    def reach(self) -> None:
        self.sequencer.reach(self.hosts, self.now, versions=self.version_of, draining=self.draining)
        self.send()

    def new_term(self) -> Sequencer:
        super().new_term()
        self.sequencer.active = ActiveVersion(self.holder)
        return self.sequencer

    def tick(self, seconds: float = 0.1) -> None:
        super().tick(seconds)
        begin = self.sequencer.handover
        if begin is not None:
            assert not self.pending, "somebody waits for a number of the term that ends"
            waiting = self.waiting
            super().new_term()
            self.waiting = waiting
            self.sequencer = Sequencer(self.epoch, mark=self.mark, holder=self.holder, begin=begin)
            self.reach()

    def ready(self, replica: int) -> bool:
        return self.hosts[replica].machine.current

    def calm(self, limit: int = 4000) -> None:
        """Let everything come to rest that can, with the right version active."""
        for _ in range(limit):
            self.now += 0.001
            working = [r for r, host in self.hosts.items() if host.work is not None]
            if self.letters:
                self.deliver(0)
            elif working:
                self.work(working[0])
            elif self.waiting or self.pending or not all(map(self.ready, self.hosts)):
                self.tick(0.5)
            else:
                break


def update(world: Versions, source: random.Random, to: str, *, kills: bool = False) -> None:
    """Replace all replicas by others, new before old, under requests and a bad network."""
    for old in [r for r, version in world.version_of.items() if version != to and r in world.hosts]:
        new = world.add(to)
        for _ in range(60):
            drive(world, source, ask_counter, 40, faults=0.0)
            world.tick(0.3)
            if kills and source.random() < 0.05:
                world.new_term()
            if world.ready(new):
                break
        else:
            world.calm()
        world.leave(old)
        for _ in range(60):  # a manager gives it ten seconds
            drive(world, source, ask_counter, 40, faults=0.0)
            world.tick(0.1)
            stay = [world.version_of[r] for r in world.hosts if r not in world.draining]
            if 2 * stay.count(to) <= len(stay) or world.sequencer.active.version == to:
                break
        world.remove_replica(old)
        drive(world, source, ask_counter, 60, faults=0.0)
    world.calm()


def one_service(world: Versions) -> list[str]:
    """Check that the answers are those of one service that changed its version; return which."""
    state, versions = 0, []
    said = sorted(world.said)
    assert [index for index, *_ in said] == list(range(1, len(said) + 1)), "a number was lost"
    for index, version, question, answer in said:
        assert question is not None
        kind, value = question
        state, expected = counter(state, (kind, value * FACTORS[version]))
        assert answer == expected, (index, version)
        if versions[-1:] != [version]:
            versions.append(version)
    return versions


@pytest.mark.parametrize("replicas", [1, 2, 3])
@pytest.mark.parametrize("seed", range(by_day(4, at_night=100)))
def test_an_update_is_one_point_of_the_order(seed, replicas):
    """Before it all answers are the old version's, after it the new one's, from its state."""
    source = random.Random(seed)
    world = Versions(replicas)
    drive(world, source, ask_counter, 200, faults=0.0)
    update(world, source, "new")
    world.ask(9, ("add", 1))
    world.calm()
    assert one_service(world) == ["old", "new"]
    assert world.said[-1][1] == "new"


@pytest.mark.parametrize("seed", range(by_day(4, at_night=100)))
def test_a_rollback_goes_on_from_the_new_versions_state(seed):
    """There and back: two points of the order, and nothing answered is forgotten."""
    source = random.Random(seed)
    world = Versions(2)
    drive(world, source, ask_counter, 100, faults=0.0)
    update(world, source, "new")
    world.ask(9, ("add", 1))
    world.calm()
    update(world, source, "old")
    world.ask(9, ("add", 1))
    world.calm()
    assert one_service(world) == ["old", "new", "old"]


@pytest.mark.parametrize("seed", range(by_day(8, at_night=200)))
def test_a_killed_proxy_never_lets_the_old_version_answer_after_the_new_one(seed):
    """Its successor knows which version was active, and begins from nobody else's state."""
    source = random.Random(seed)
    world = Versions(1 + seed % 3)
    drive(world, source, ask_counter, 100, faults=0.0)
    update(world, source, "new", kills=True)
    world.ask(9, ("add", 1))
    world.calm()
    versions = [version for _, version, *_ in world.said]
    assert versions == sorted(versions, reverse=True), "old before new"
    assert versions[-1] == "new"


@pytest.mark.parametrize("seed", range(6))
def test_who_stands_by_follows_a_version_that_is_gone(seed):
    """All of the active version are lost at once: the other one goes on, nothing is lost."""
    source = random.Random(seed)
    world = Versions(2)
    drive(world, source, ask_counter, 100, faults=0.0)
    new = world.add("new")
    world.calm()
    assert world.ready(new)
    answered = len(world.said)
    for replica in [r for r in world.hosts if r != new]:
        world.remove_replica(replica)
    world.ask(9, ("get", 0))
    for _ in range(20):
        world.tick(VACANCY_S / 5)
        world.calm()
    assert len(world.said) > answered
    assert world.said[-1][1] == "new"
    assert not world.pending
    assert not world.waiting


def test_a_version_that_stands_by_is_never_believed():
    """However fast it is, its answer is nobody's answer."""
    world = Versions(2)
    world.calm()
    new = world.add("new")
    world.calm()
    for _ in range(30):
        world.ask(0, ("add", 1))
        while world.letters or any(host.work for host in world.hosts.values()):
            if world.hosts[new].work is not None:
                world.work(new)
            elif world.letters:
                world.deliver(len(world.letters) - 1)
            else:
                world.work(next(r for r, host in world.hosts.items() if host.work is not None))
        world.tick()
    assert {version for _, version, *_ in world.said} == {"old"}


@pytest.mark.parametrize(
    ("holder", "staying", "wish"),
    [
        ("a", ["a", "b"], None),
        ("a", ["a", "b", "b"], "b"),
        ("a", ["b"], "b"),
        ("a", [], None),
        (None, ["b"], None),
        ("b", ["b", "a", "a"], "a"),
    ],
)
def test_the_version_of_most_that_stay_becomes_active(holder, staying, wish):
    """Equal numbers change nothing: so it does not go back and forth."""
    assert ActiveVersion(holder).wanted(staying) == wish


def test_a_version_is_gone_only_after_a_while():
    """A link that comes up a little later than another decides nothing."""
    active = ActiveVersion("a")
    active.look(["b"], 0.0)
    active.look(["b"], VACANCY_S - 0.1)
    assert (active.successor(["b"]), active.may_lead("b")) == (None, False)
    active.look(["b", "a"], VACANCY_S)
    active.look(["b"], VACANCY_S + 1)
    assert active.successor(["b"]) is None
    active.look(["b"], 3 * VACANCY_S)
    assert (active.successor(["b"]), active.may_lead("b")) == ("b", True)
