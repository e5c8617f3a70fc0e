"""The policies at work: a dispatcher before simulated replicas, in simulated time."""

from __future__ import annotations

import random
from functools import cache
from statistics import median

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fogft.model.refusal import Refusal
from fogft.model.spec import HedgingMode
from fogft.requests.load import Load
from tests.estimates import percentile
from tests.nightly import NIGHTLY, by_day
from tests.proxy.robot.simulated import Draws, SimulatedIncoming, SimulatedLink, World, lognormal

AUTO, FAILOVER = HedgingMode.AUTO, HedgingMode.FAILOVER


def constant(seconds: float):
    return lambda source: seconds


def exponential(mean_s: float):
    return lambda source: source.expovariate(1.0 / mean_s)


# Name: service times with a mean of 20 ms, lognormal ones with one in a hundred ten times as long.
ONE_WAY_S = 0.001
SERVICES = {
    "constant": constant(0.02),
    "exponential": exponential(0.02),
    "stalling": lognormal(0.0175, 0.3, stalls=0.01, stall_s=0.175),
}

LOADS = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9) if NIGHTLY else (0.1, 0.3, 0.7, 0.9)


def served(
    mode: HedgingMode,
    service: str,
    load: float,
    *,
    robots: int = 1,
    seconds: float = 40.0,
    seed: int = 3,
):
    """Let robots ask three serial replicas, at a share of what these can do."""
    worlds, draws = [World(mode, timeout_s=2.0)], Draws(seed)
    for _ in range(3):
        worlds[0].replica(SERVICES[service], serial=True).replica.service.draws = draws
    worlds += [World(mode, timeout_s=2.0, beside=worlds[0]) for _ in range(robots - 1)]
    arrivals, source = random.Random(seed), random.Random(4)
    end = worlds[0].now + seconds
    while worlds[0].now < end:
        worlds[0].run(arrivals.expovariate(load * 150.0))
        source.choice(worlds).ask()
    worlds[0].run(2.5)
    return worlds


def p99(worlds) -> float:
    return percentile([latency for world in worlds for latency in world.latencies()], 99)


def lost(worlds) -> int:
    return sum(len(world.asked) - len(world.answers) for world in worlds)


def shortest_queue(service: str, load: float, seconds: float = 40.0, seed: int = 3) -> float:
    """Return the p99 of one copy a request to the shortest of three queues, less the round trip.

    Requests come when they come to `served`, are as much work, and the network is the same: what
    has ended counts until its answer is here.
    """
    arrivals, draws, now, latencies = random.Random(seed), Draws(seed), 0.0, []
    ends: list[list[float]] = [[], [], []]
    while now < seconds:
        now += arrivals.expovariate(load * 150.0)
        for queue in ends:
            queue[:] = [end for end in queue if end + ONE_WAY_S > now]
        queue = min(ends, key=len)
        end = max([now + ONE_WAY_S, *queue[-1:]]) + SERVICES[service](draws(b"%d" % len(latencies)))
        queue.append(end)
        latencies.append(end - ONE_WAY_S - now)
    return percentile(latencies, 99)


@pytest.mark.parametrize("service", sorted(SERVICES))
@pytest.mark.parametrize("load", LOADS)
def test_auto_is_as_good_as_the_shortest_queue_and_as_all_from_idle_to_full(service, load):
    """Beyond the round trip, p99 is at most 1.05 of the better of the two; none is lost."""
    seconds, ratios = 20.0 / load, []  # as many requests at each load
    for seed in range(3, 3 + by_day(1, at_night=15)):
        better = shortest_queue(service, load, seconds, seed)
        if load <= 0.2:  # of more load `all` makes an endless queue
            worlds = served(HedgingMode.ALL, service, load, seconds=seconds, seed=seed)
            better = min(better, p99(worlds) - 2 * ONE_WAY_S)
        worlds = served(AUTO, service, load, seconds=seconds, seed=seed)
        assert lost(worlds) == 0
        ratios.append((p99(worlds) - 2 * ONE_WAY_S) / better)
    assert median(ratios) <= 1.05


def test_copies_become_fewer_with_load():
    """Mean copies that are run: of idle replicas more than one, near none of full ones."""
    ran = []
    for load in (0.02, 0.1, 0.3, 0.6, 0.9):
        [world] = served(AUTO, "constant", load)
        ran.append(sum(link.replica.service.ran for link in world.links) / len(world.asked))
    assert ran == sorted(ran, reverse=True)
    assert ran[0] > 1.7
    assert ran[-1] < 1.05


@pytest.mark.parametrize("pause_s", [0.001, 0.2])
def test_a_lone_caller_is_answered_by_all_and_no_loss_is_seen(pause_s):
    """Idle: every replica has each request, so a replica that vanishes costs no time at all.

    Also where it asks again at once, while the others are just ending the request before.
    """
    world = World(AUTO)
    for _ in range(3):
        world.replica(constant(0.05), serial=True)
    world.calls(20, pause_s=pause_s)
    world.links[0].frozen = True
    before = len(world.asked)
    world.calls(5, pause_s=pause_s)
    assert max(world.latencies(before)) == pytest.approx(max(world.latencies()[:before]), abs=0.002)


@pytest.mark.parametrize("load", [0.3, 0.5])
def test_a_frozen_replica_loses_nothing_and_costs_little_before_it_is_suspected(load):
    """Its link is suspect after 2 s; until then others take what it has, and what comes."""
    world = World(AUTO, timeout_s=2.0)
    for _ in range(3):
        world.replica(SERVICES["constant"], serial=True)
    world.poisson(load * 150, 10.0, random.Random(1))
    before = len(world.asked)
    world.links[0].frozen = True
    world.poisson(load * 150, 2.0, random.Random(2))
    world.links[0].lose()
    world.poisson(load * 150, 3.0, random.Random(3))
    world.run(2.5)
    latencies = world.latencies(before)
    assert len(latencies) == len(world.asked) - before
    assert percentile(latencies, 99) < 0.2


@pytest.mark.parametrize("mode", [HedgingMode.AUTO, HedgingMode.FAILOVER])
def test_a_service_that_hangs_for_a_while_loses_nothing_and_gets_requests_again(mode):
    world = World(mode, timeout_s=2.0)
    for _ in range(3):
        world.replica(SERVICES["constant"], serial=True)
    world.poisson(20.0, 10.0, random.Random(1))
    world.links[0].replica.service.hangs_until = world.now + 5.0
    world.poisson(20.0, 15.0, random.Random(1))
    world.run(2.5)
    assert lost([world]) == 0
    if mode is AUTO:
        ran = [link.replica.service.ran for link in world.links]
        assert min(ran) > 0.1 * sum(ran)


IDLE = Load(0, 0, 64, 0.0, 0.0)


def lies(link: SimulatedLink, how: str) -> None:
    """Have a replica answer nothing, whatever else it says. It always says that it is idle."""
    kept = []

    def request(incoming: SimulatedIncoming) -> None:
        kept.append(incoming)
        if how == "junk":
            incoming.refuse(Refusal.LOST)  # what is made of an answer that cannot be decoded
        elif how == "crashed":
            incoming.refuse(Refusal.CRASHED, load=IDLE)
        elif how == "boasting" and len(kept) % 10 == 0:
            incoming.refuse(Refusal.OVERLOADED, load=IDLE)

    link.replica.responder.request = request  # type: ignore[method-assign]


@cache
def beside_liars(how: str, liars: int, *, replicas: int = 3) -> list[list[float]]:
    """Return how long requests took: one after the other, and at random moments."""
    found = []
    for one_by_one in (True, False):
        world = World(AUTO, timeout_s=2.0)
        for _ in range(replicas):
            world.replica(SERVICES["constant"], serial=True)
        world.poisson(20.0, 10.0, random.Random(1))
        world.run(1.0)
        before = len(world.asked)
        for link in world.links[:liars]:
            lies(link, how)
        if one_by_one:
            world.calls(500)
        else:
            world.poisson(20.0, 30.0, random.Random(2))
        world.run(2.5)
        assert liars > 1 or lost([world]) == 0
        found.append(world.latencies(before))
    return found


@pytest.mark.parametrize("liars", [1, 2])
@pytest.mark.parametrize("how", ["junk", "crashed", "swallowed", "boasting"])
def test_liars_cost_no_more_than_their_absence_would(how, liars):
    """p50 and p99 are at most 1.2 of those of a calm pool of three, where no request waits.

    At random moments requests wait for each other: there, of a pool in which only the others are.
    """
    one_by_one, at_random = beside_liars(how, liars)
    calm, _ = beside_liars("none", 0)
    _, fewer = beside_liars("none", 0, replicas=3 - liars)
    for percent in (50, 99):
        assert percentile(one_by_one, percent) <= 1.2 * percentile(calm, percent)
        assert percentile(at_random, percent) <= 1.2 * percentile(fewer, percent)


@pytest.mark.parametrize("fault", ["killed", "frozen", "hangs"])
@pytest.mark.parametrize("service", ["constant", "exponential"])
def test_a_fault_at_seventy_percent_costs_little_beyond_the_replica(fault, service):
    """Nothing is lost; p99 during it is at most 1.25 of a third that left in good order."""
    assert during("leaves", service) * 1.25 >= during(fault, service)


@cache
def during(fault: str, service: str, seconds: float = 6.0) -> float:
    """Return p99 from a fault on, at 70 % of what three replicas can do."""
    world = World(AUTO, timeout_s=2.0)
    for _ in range(3):
        world.replica(SERVICES[service], serial=True)
    world.poisson(105.0, 10.0, random.Random(1))
    before, link = len(world.asked), world.links[0]
    if fault == "leaves":
        del world.links[0]
        world.route()
    elif fault == "hangs":
        link.replica.service.hangs_until = world.now + seconds
    else:
        link.frozen = fault == "frozen"
        world.at(world.now + (2.0 if fault == "frozen" else 0.003), link.lose)
    world.poisson(105.0, seconds, random.Random(2))
    world.run(2.5)
    assert lost([world]) == 0
    return percentile(world.latencies(before), 99)


def test_what_a_replica_that_says_it_hangs_has_goes_to_others_at_once():
    """Of one that has answered little the robot itself would see nothing for 2 s."""
    for mode in (AUTO, FAILOVER):
        world = World(mode)
        world.replica(constant(1.0), serial=True)
        world.replica(constant(0.1), serial=True)
        world.links[0].frozen = True
        while not world.links[0].offers:
            world.ask()
        world.run(0.5)
        world.dispatcher.route(world.links, hanging={world.links[0].peer.id})
        world.run(0.5)
        assert lost([world]) == 0


def test_one_that_is_ten_times_as_slow_gets_few_requests():
    world = World(AUTO, timeout_s=2.0)
    for service_s in (0.2, 0.02, 0.02):
        world.replica(constant(service_s), serial=True)
    world.poisson(50.0, 20.0, random.Random(1))
    world.run(2.5)
    assert lost([world]) == 0
    assert next(world.shares()) < 0.1
    assert percentile(world.latencies(), 99) < 0.1


@pytest.mark.parametrize("load", [0.3, 0.7])
def test_five_robots_with_views_of_their_own_share_what_there_is(load):
    worlds = served(AUTO, "constant", load, robots=5)
    assert lost(worlds) == 0
    assert p99(worlds) <= 2.0 * shortest_queue("constant", load) + 0.010


def test_over_capacity_what_is_answered_is_answered_in_time_and_the_rest_costs_no_work():
    """At 150 % nearly all that three can do is done, and afterwards all is as before."""
    [world] = served(AUTO, "constant", 1.5, seconds=20.0)
    assert len(world.answers) >= 0.95 * 150 * 20
    assert world.dispatcher.report()["needed_replicas"] in (4, 5, 6)  # 4.5 would be full
    before = len(world.asked)
    world.poisson(45.0, 5.0, random.Random(2))
    world.run(2.5)
    latencies = world.latencies(before)
    assert len(latencies) == len(world.asked) - before
    assert percentile(latencies, 50) < 0.025
    world.poisson(75.0, 20.0, random.Random(3))
    assert world.dispatcher.report()["needed_replicas"] == 0


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


def test_failover_recovers_from_a_service_that_hangs():
    world = World(FAILOVER, timeout_s=1.0)
    for _ in range(2):
        world.replica(lognormal(0.05, 0.1))
    world.links[0].frozen = True
    world.poisson(10.0, 10.0, random.Random(1))
    world.run(2.0)
    late = [n for n, asked_at in world.asked.items() if asked_at > 1000.0 + 2.0]
    assert {n for n, _, _ in world.answers} >= set(late)


def test_failover_hedges_a_request_that_hangs_long_before_its_deadline():
    world = World(FAILOVER, timeout_s=10.0)
    for _ in range(2):
        world.replica(lognormal(0.05, 0.1))
    world.poisson(10.0, 5.0, random.Random(1))
    before = len(world.asked)
    world.links[0].frozen = True
    world.poisson(10.0, 5.0, random.Random(1))
    world.run(2.0)
    assert lost([world]) == 0
    assert max(world.latencies(before)) < 1.0


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
        world.links[slot].replica.service.source.seed(seed + slot)
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
