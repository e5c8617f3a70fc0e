"""The policies at work: a dispatcher before simulated replicas, in simulated time."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fogft.model.spec import HedgingMode
from fogft.requests.adaptive import BUDGET_CAPACITY
from tests.estimates import percentile
from tests.nightly import by_day
from tests.proxy.robot.simulated import World, lognormal

STALLING = lognormal(0.1, 0.35, stalls=0.01)
ADAPTIVE, ALL, FAILOVER = HedgingMode.ADAPTIVE, HedgingMode.ALL, HedgingMode.FAILOVER


@pytest.mark.parametrize("replicas", [2, 3])
def test_adaptive_hedging_cuts_the_tail_with_few_copies(replicas):
    """p99 below three medians of a replica that never stalls, with 1.10 copies a request."""
    world = World(ADAPTIVE)
    for _ in range(replicas):
        world.replica(STALLING)
    world.poisson(8.0, 300.0, random.Random(7))
    world.run(12.0)
    latencies = world.latencies()
    assert len(latencies) == len(world.asked)
    assert percentile(latencies, 99) <= 3.0 * 0.1
    assert world.copies() <= 1.10


def test_the_best_replica_gets_nearly_all():
    world = World(ADAPTIVE)
    for median_s in (0.2, 0.05, 0.1):
        world.replica(lognormal(median_s, 0.3))
    world.poisson(8.0, 120.0, random.Random(1))
    assert list(world.shares())[1] > 0.85


def test_when_the_best_freezes_requests_go_on_before_it_is_suspected():
    """Its link is suspect after 2 s; until then the budget must last, and no request wait."""
    world = World(ADAPTIVE)
    for median_s in (0.05, 0.06):
        world.replica(lognormal(median_s, 0.3))
    world.poisson(20.0, 60.0, random.Random(1))
    before = len(world.asked)
    world.links[0].frozen = True
    world.poisson(20.0, 2.0, random.Random(2))
    world.links[0].lose()
    world.poisson(20.0, 5.0, random.Random(3))
    world.run(11.0)
    latencies = world.latencies(before)
    assert len(latencies) == len(world.asked) - before
    assert percentile(latencies, 95) < 0.4


@pytest.mark.parametrize("hedging", list(HedgingMode))
def test_what_a_suspect_link_had_goes_to_another_at_once(hedging):
    world = World(hedging)
    for _ in range(2):
        world.replica(lognormal(1.0, 0.0))
    world.ask()
    world.run(0.1)
    for link in world.links[:1]:
        link.lose()
    world.run(1.05)
    assert len(world.answers) == 1


def test_a_burst_on_serial_replicas_is_shared():
    """Two that work on one request after the other: one alone would take twice as long."""
    world = World(ADAPTIVE)
    for _ in range(2):
        world.replica(lognormal(0.02, 0.1), serial=True)
    world.poisson(75.0, 60.0, random.Random(1))
    world.run(11.0)
    assert len(world.answers) == len(world.asked)
    assert percentile(world.latencies(), 99) < 0.5
    assert min(world.shares()) > 0.3


def test_failover_recovers_from_a_service_that_hangs():
    world = World(FAILOVER, timeout_s=1.0)
    for _ in range(2):
        world.replica(lognormal(0.05, 0.1))
    world.links[0].frozen = True
    world.poisson(10.0, 10.0, random.Random(1))
    world.run(2.0)
    late = [n for n, asked_at in world.asked.items() if asked_at > 1000.0 + 2.0]
    assert {n for n, _, _ in world.answers} >= set(late)


modes = st.sampled_from(list(HedgingMode))
steps = st.lists(
    st.one_of(
        st.tuples(st.just("ask"), st.integers(1, 5)),
        st.tuples(st.just("run"), st.floats(0.001, 0.5)),
        st.tuples(st.just("freeze"), st.integers(0, 2)),
        st.tuples(st.just("lose"), st.integers(0, 2)),
        st.tuples(st.just("come"), st.integers(0, 2)),
        st.tuples(st.just("change"), modes),
    ),
    max_size=40,
)


@settings(max_examples=by_day(40, at_night=400), deadline=None)
@given(modes, steps, st.integers(0, 1000))
def test_laws_of_every_policy_and_of_changing_it(mode, steps, seed):
    """One answer a request, its own, never after its deadline; none is lost that can be answered.

    Whatever freezes, is lost, comes back, and however often the policy changes meanwhile.
    """
    world = World(mode, timeout_s=2.0)
    for slot in range(3):
        world.replica(lognormal(0.05, 0.5, stalls=0.1, stall_s=1.0))
        world.links[slot].source.seed(seed + slot)
    for step, value in steps:
        if step == "ask":
            for _ in range(value):
                world.ask()
        elif step == "run":
            world.run(value)
        elif step == "change":
            world.change(value)
        elif step == "freeze":
            world.links[value].frozen = True
        elif step == "lose":
            world.links[value].lose()
        elif step == "come":
            world.links[value].frozen, world.links[value].usable = False, True
            world.route()
    world.run(3.0)
    answered = [number for number, _, _ in world.answers]
    assert len(answered) == len(set(answered))
    for number, at, payload in world.answers:
        assert payload == b"%d" % number
        assert at < world.asked[number] + 2.0
    report = world.dispatcher.report()
    assert report["received"] == report["answered"] + report["silent"]
    assert report["pending"] == 0
    # Replicas that live and stay answer in time, so nothing is lost to a change of the policy.
    if not {"freeze", "lose"} & {step for step, _ in steps}:
        assert report["silent"] == 0


@settings(max_examples=by_day(15, at_night=200), deadline=None)
@given(
    st.floats(0.01, 0.5), st.floats(1.0, 50.0), st.floats(0.005, 1.0), st.integers(2, 4),
    st.integers(0, 1000),
)  # fmt: skip
def test_extra_copies_stay_within_the_budget(budget, rate, median_s, replicas, seed):
    """Whatever the load and the latencies: copies <= requests * (1 + budget) + the capacity."""
    world = World(ADAPTIVE, budget=budget, timeout_s=60.0)
    for _ in range(replicas):
        world.replica(lognormal(median_s, 1.0, stalls=0.05))
    world.poisson(rate, 200 / rate, random.Random(seed))
    copies = sum(link.offers for link in world.links)
    assert copies <= len(world.asked) * (1 + budget) + BUDGET_CAPACITY
