"""The policies at work: a dispatcher before simulated replicas, in simulated time."""

from __future__ import annotations

import heapq
import operator
import random
from collections import defaultdict
from collections.abc import Callable
from functools import cache, partial
from statistics import fmean

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fogft.model.refusal import Refusal
from fogft.model.spec import HedgingMode
from fogft.proxy.robot import dispatcher
from fogft.requests.choose import Choose
from fogft.requests.load import Load, ReplicaLoad
from tests.estimates import percentile
from tests.nightly import NIGHTLY, by_day
from tests.proxy.robot.simulated import (
    KILLS,
    RESTART_S,
    Draws,
    SimulatedIncoming,
    SimulatedLink,
    World,
    lognormal,
)

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

LOADS = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95) if NIGHTLY else (0.1, 0.3, 0.7, 0.9)

# Name: when all three replicas, or one after the other, take five times as long for a second.
SPELLS = {
    "together": lambda slot, now: 5.0 if now % 10.0 < 1.0 else 1.0,
    "one by one": lambda slot, now: 5.0 if (now - 3.0 * slot) % 10.0 < 1.0 else 1.0,
    "none": lambda slot, now: 1.0,
}


def pool(
    service: str,
    *,
    robots: int = 1,
    seed: int = 3,
    mode: HedgingMode = AUTO,
    spells: str = "none",
    rtt_s: float = 2 * ONE_WAY_S,
):
    """Return robots before three serial replicas."""
    worlds, draws = [World(mode, timeout_s=2.0)], Draws(seed)
    for slot in range(3):
        link = worlds[0].replica(SERVICES[service], serial=True, rtt_s=rtt_s)
        made = link.replica.service
        made.draws, made.pace = draws, partial(SPELLS[spells], slot)
    return worlds + [World(mode, timeout_s=2.0, beside=worlds[0]) for _ in range(robots - 1)]


def offered(worlds, load: float, seconds: float, seed: int = 3) -> None:
    """Let robots ask at a share of what three replicas can do."""
    arrivals, source = random.Random(seed), random.Random(4)
    end = worlds[0].now + seconds
    while worlds[0].now < end:
        worlds[0].run(arrivals.expovariate(load * 150.0))
        source.choice(worlds).ask()


def served(
    mode: HedgingMode,
    service: str,
    load: float,
    *,
    robots: int = 1,
    seconds: float = 40.0,
    seed: int = 3,
    spells: str = "none",
):
    """Let robots ask, and wait for the last answer."""
    worlds = pool(service, robots=robots, seed=seed, mode=mode, spells=spells)
    offered(worlds, load, seconds, seed)
    worlds[0].run(2.5)
    return worlds


def p99(worlds) -> float:
    return percentile([latency for world in worlds for latency in world.latencies()], 99)


def lost(worlds) -> int:
    return sum(len(world.asked) - len(world.answers) for world in worlds)


def answered(worlds, since: float, until: float) -> int:
    """Count the answers within a time."""
    return sum(since <= at < until for world in worlds for _, at, _ in world.answers)


def central_queue(service: str, load: float, seconds: float, seed: int = 3) -> int:
    """Count what one queue before three services ends in time, with no copies and no network."""
    arrivals, draws, now, ended, number = random.Random(seed), Draws(seed), 0.0, 0, 0
    free_at = [0.0] * 3
    while now < seconds:
        now += arrivals.expovariate(load * 150.0)
        begun = max(now, heapq.heappop(free_at))
        end = begun + SERVICES[service](draws(b"%d" % number))
        heapq.heappush(free_at, end)
        number += 1
        ended += end < seconds
    return ended


def shortest(queues: list[list[float]], source: random.Random) -> int:
    return min(range(3), key=lambda slot: len(queues[slot]))


def an_idle_one(queues: list[list[float]], source: random.Random) -> int:
    """Return one where nothing is, if there is one; else any."""
    return source.choice([slot for slot in range(3) if not queues[slot]] or range(3))


def one_copy(
    rule: Callable[[list[list[float]], random.Random], int],
    service: str,
    load: float,
    seconds: float = 40.0,
    seed: int = 3,
    spells: str = "none",
) -> float:
    """Return the p99 of one copy a request, before three queues, less the round trip.

    Requests come when they come to `served`, are as much work, and the network is the same: what
    has ended counts until its answer is here.
    """
    arrivals, draws, now, latencies = random.Random(seed), Draws(seed), 0.0, []
    ends: list[list[float]] = [[], [], []]
    source = random.Random(seed)
    while now < seconds:
        now += arrivals.expovariate(load * 150.0)
        for queue in ends:
            queue[:] = [end for end in queue if end + ONE_WAY_S > now]
        slot = rule(ends, source)
        begun = max([now + ONE_WAY_S, *ends[slot][-1:]])
        work_s = SERVICES[service](draws(b"%d" % len(latencies)))
        end = begun + work_s * SPELLS[spells](slot, begun)
        ends[slot].append(end)
        latencies.append(end - ONE_WAY_S - now)
    return percentile(latencies, 99)


@pytest.mark.parametrize("service", sorted(SERVICES))
@pytest.mark.parametrize("load", LOADS)
def test_auto_is_as_good_as_the_best_other_rule_from_idle_to_full(service, load):
    """Beyond the round trip, p99 is at most 1.05 of the better of two others; none is lost.

    These are one copy to the shortest queue, and all. It is never worse than one copy to an idle
    replica, or to any where none is.
    """
    seconds, ratios, of_idle = 20.0 / load, [], []  # as many requests at each load
    chance = load >= 0.7 and service != "constant"
    for seed in range(3, 3 + by_day(4 if chance else 1, at_night=20)):
        better = one_copy(shortest, service, load, seconds, seed)
        if load <= 0.2:  # of more load `all` makes an endless queue
            worlds = served(HedgingMode.ALL, service, load, seconds=seconds, seed=seed)
            better = min(better, p99(worlds) - 2 * ONE_WAY_S)
        worlds = served(AUTO, service, load, seconds=seconds, seed=seed)
        assert lost(worlds) == 0
        ratios.append((p99(worlds) - 2 * ONE_WAY_S) / better)
        idle = one_copy(an_idle_one, service, load, seconds, seed)
        of_idle.append((p99(worlds) - 2 * ONE_WAY_S) / idle)
    assert fmean(ratios) <= 1.05
    assert fmean(of_idle) <= 1.0


@pytest.mark.parametrize(
    ("service", "load", "most"),
    [("constant", 0.05, 1.4), ("constant", 0.1, 1.05), ("stalling", 0.1, 1.05)],
)
def test_while_replicas_slow_down_in_turns_an_idle_pool_does_as_well_as_with_all_copies(
    service, load, most
):
    """What spare copies saved in one slow spell is remembered for the next.

    Where they save nothing otherwise, the one that has become slow is asked no more meanwhile, and
    the first request there is hedged: what it was tried with since does not make it seem slow.
    """
    ratios = []
    for seed in range(3, 3 + by_day(4, at_night=12)):
        p99s = [
            p99(served(mode, service, load, seconds=200.0, seed=seed, spells="one by one"))
            for mode in (AUTO, HedgingMode.ALL)
        ]
        ratios.append((p99s[0] - 2 * ONE_WAY_S) / (p99s[1] - 2 * ONE_WAY_S))
    assert fmean(ratios) <= most


@pytest.mark.parametrize(
    ("service", "load"), [("constant", 0.05), ("stalling", 0.3), ("exponential", 0.7)]
)
def test_while_all_slow_down_together_it_does_as_well_as_one_copy_to_the_shortest_queue(
    service, load
):
    """None is left alone for long because it was asked only while it was slow."""
    ratios = []
    for seed in range(3, 3 + by_day(6, at_night=20)):
        seconds = max(40.0, 20.0 / load)
        worlds = served(AUTO, service, load, seconds=seconds, seed=seed, spells="together")
        better = one_copy(shortest, service, load, seconds, seed, "together")
        ratios.append((p99(worlds) - 2 * ONE_WAY_S) / better)
    assert fmean(ratios) <= 1.05


@pytest.mark.parametrize("robots", [1, 5])
@pytest.mark.parametrize("service", sorted(SERVICES))
def test_nearly_full_they_end_as_much_as_one_queue_before_them_without_copies(service, robots):
    """At 95 % at least 0.97 of it, though each robot knows of what it asks itself only."""
    worlds = served(AUTO, service, 0.95, robots=robots, seconds=20.0)
    assert answered(worlds, 1000.0, 1020.0) >= 0.97 * central_queue(service, 0.95, 20.0)


@pytest.mark.parametrize("service", sorted(SERVICES))
def test_copies_become_fewer_with_load(service):
    """Mean copies that are run: of idle replicas more than one, near none of full ones."""
    ran = []
    for load in (0.02, 0.1, 0.3, 0.6, 0.9):
        [world] = served(AUTO, service, load, seconds=20.0 if load < 0.9 else 40.0)
        ran.append(sum(link.replica.service.ran for link in world.links) / len(world.asked))
    assert ran == sorted(ran, reverse=True)
    assert ran[0] > 1.7
    assert ran[-1] < 1.05


def killed(service: str, load: float) -> tuple[World, int, list[bytes]]:
    """Send three requests that kill among others.

    Returns:
        Where; the first of the others; those that were at all replicas at once after a death.
    """
    [world] = pool(service)
    offered([world], load, 10.0)
    before, at_all = len(world.asked), set[bytes]()

    def look() -> None:
        at_all.update(id for id in world.links[0].open if all(id in x.open for x in world.links))
        world.at(world.now + 0.001, look)

    for number in range(3):
        world.kill()
        offered([world], load, 3.0)
        if number == 0:
            look()
    world.run(2.5)
    assert world.dispatcher.report()["poison"] == 3
    assert lost([world]) == 0
    return world, before, sorted(at_all)


@pytest.mark.parametrize(("load", "longest_s"), [(0.1, 0.08), (0.3, 0.3)])
def test_a_request_that_kills_harms_only_itself(load, longest_s):
    """Each ends two services, never the last one. Others are sent again at once, and none is lost.

    At 30 % they wait for the one replica that is left for a second.
    """
    world, before, _ = killed("constant", load)
    assert max(world.latencies(before)) < longest_s
    deaths = [link.replica.deaths for link in world.links]
    assert sum(map(len, deaths)) == 6
    for at in (at for of in deaths for at in of):
        assert sum(any(died <= at < died + RESTART_S for died in of) for of in deaths) < 3


def test_for_a_minute_after_a_death_no_request_is_at_all_replicas_at_once():
    """Also of a service whose requests are at every idle one else."""
    world, _, at_all = killed("exponential", 0.05)
    assert at_all == []
    assert sum(len(link.replica.deaths) for link in world.links) <= (3 + 1) + 2 * (1 + 1)


@pytest.mark.parametrize("replicas", [2, 3])
@pytest.mark.parametrize("mode", [AUTO, HedgingMode.ALL])
def test_a_replica_that_dies_over_all_requests_ends_none_that_another_works_on(mode, replicas):
    """Also where that takes so long that it is asked a second time meanwhile."""
    world = World(mode)
    links = [world.replica(constant(6.0)) for _ in range(replicas)]
    broken = links[0].replica.service
    broken.call = partial(lambda call, _, told: call(KILLS, told), broken.call)  # type: ignore[method-assign]
    for _ in range(20):
        world.ask()
        world.run(7.0)
    world.run(4.0)
    assert len(links[0].replica.deaths) > 3
    assert lost([world]) == 0


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


def by_one_who_sees_all(means_s: list[float], rtts_s: list[float], load: float, seed: int) -> float:
    """Return the p99 where each request goes to where it should end first, by queues as they are.

    The services take exponential times.
    """
    arrivals, draws, now, latencies = random.Random(seed), random.Random(seed + 1), 0.0, []
    rate, ends = load * sum(1.0 / mean_s for mean_s in means_s), [list[float]() for _ in means_s]
    while now < 200.0:
        now += arrivals.expovariate(rate)
        expected_s = []
        for queue, mean_s, rtt_s in zip(ends, means_s, rtts_s, strict=True):
            queue[:] = [end for end in queue if end > now]
            expected_s.append(rtt_s + mean_s * (1 + len(queue)))
        slot = expected_s.index(min(expected_s))
        begun = max([now + rtts_s[slot] / 2, *ends[slot][-1:]])
        ends[slot].append(begun + exponential(means_s[slot])(draws))
        latencies.append(ends[slot][-1] + rtts_s[slot] / 2 - now)
    return percentile(latencies, 99)


@pytest.mark.parametrize(
    ("means_s", "rtts_s"),
    [
        ([0.02, 0.02, 0.06], [0.002] * 3),
        ([0.02] * 3, [0.005, 0.04, 0.08]),
        ([0.06, 0.02, 0.02], [0.005, 0.03, 0.03]),
    ],
    ids=["one is slow", "near and far", "the near one is slow"],
)
def test_unlike_replicas_get_what_each_can_do(means_s, rtts_s):
    """Other machines, other regions: little beyond who sees all queues at once."""
    world = World(AUTO)
    for mean_s, rtt_s in zip(means_s, rtts_s, strict=True):
        world.replica(exponential(mean_s), serial=True, rtt_s=rtt_s)
    world.poisson(0.7 * sum(1.0 / mean_s for mean_s in means_s), 40.0, random.Random(3))
    world.run(11.0)
    assert lost([world]) == 0
    assert p99([world]) <= 1.3 * by_one_who_sees_all(means_s, rtts_s, 0.7, 3)


def test_one_that_is_ten_times_as_slow_gets_few_requests():
    world = World(AUTO, timeout_s=2.0)
    for service_s in (0.2, 0.02, 0.02):
        world.replica(constant(service_s), serial=True)
    world.poisson(50.0, 20.0, random.Random(1))
    world.run(2.5)
    assert lost([world]) == 0
    assert next(world.shares()) < 0.1
    assert percentile(world.latencies(), 99) < 0.1


@pytest.mark.parametrize("how", ["first call", "hangs"])
def test_one_call_that_takes_seconds_costs_a_replica_its_share_for_seconds_only(how):
    """Where copies gain nothing it is hardly asked for them: its word then stays what it was."""
    [world] = pool("constant")
    if how == "hangs":
        offered([world], 0.5, 10.0)
        slow = world.links[0]
        slow.replica.service.hangs_until = world.now + 5.0
        offered([world], 0.5, 5.0)
    else:
        world.links.pop().usable = False
        world.route()
        offered([world], 0.5, 10.0)
        times = iter([5.0])
        slow = world.replica(lambda source: next(times, 0.02), serial=True)
        offered([world], 0.5, 5.0)
    offered([world], 0.5, 7.0)
    before, ran = len(world.asked), [link.replica.service.ran for link in world.links]
    offered([world], 0.5, 5.0)
    world.run(0.5)
    ran = [link.replica.service.ran - n for link, n in zip(world.links, ran, strict=True)]
    assert ran[world.links.index(slow)] > 0.2 * sum(ran)
    assert percentile(world.latencies(before), 50) < 0.03


class Shortest(Choose):
    """One copy to the shortest queue, as far as each robot knows."""

    def __init__(self) -> None:
        self.replicas: defaultdict[int, ReplicaLoad] = defaultdict(ReplicaLoad)

    def first(self, request, able, now):
        best = min(able, key=lambda one: (self.replicas[one].ahead(now), request[one % 16]))
        self.replicas[best].asked(request, now)
        return (best,)

    def more(self, request, open, candidates, now):
        return self.first(request, candidates, now) if candidates and not open else ()

    def heard(self, request, replica, load, now):
        self.replicas[replica].heard(request, load, now)

    def answered(self, request, open, replica, load, now):
        self.replicas[replica].answered(request, load, now)


@pytest.mark.parametrize("service", sorted(SERVICES))
@pytest.mark.parametrize("load", [0.3, 0.7])
def test_five_robots_with_stale_views_do_as_well_as_shortest_queues_by_the_same_views(
    load, service, monkeypatch
):
    worlds = served(AUTO, service, load, robots=5)
    assert lost(worlds) == 0
    assert needed(worlds) == {0}
    monkeypatch.setattr(dispatcher, "Auto", Shortest)
    assert p99(worlds) <= 1.15 * p99(served(AUTO, service, load, robots=5))


@pytest.mark.parametrize(
    ("service", "rtt_s"), [("constant", 0.002), ("constant", 0.05), ("stalling", 0.05)]
)
def test_over_capacity_what_is_answered_is_answered_in_time_and_the_rest_costs_no_work(
    service, rtt_s
):
    """At 150 % nearly all that three can do is done, and the pool is known to be too small.

    However far away they are: what replicas end just in time must still be here in time. What all
    have refused is not offered again and again.
    """
    [world], seconds = pool(service, rtt_s=rtt_s), 12.0
    offered([world], 1.5, seconds)
    assert needed([world]) == {6}  # 4.5 would be full
    could = central_queue(service, 1.5, seconds)  # 1800, were each as much work as on average
    assert answered([world], 1000.0, 1000.0 + seconds) >= 0.95 * could
    assert world.copies() < 3.0
    world.poisson(75.0, 20.0, random.Random(3))
    assert needed([world]) == {0}


@pytest.mark.parametrize("robots", [1, 5])
@pytest.mark.parametrize("service", ["constant", "stalling"])
def test_five_seconds_after_an_overload_all_is_as_it_was_before(service, robots):
    """The times, and who does how much; what waits does not grow while it lasts.

    Meanwhile each robot has the same share, and sees how many replicas all of them need.
    """
    worlds = pool(service, robots=robots)
    seconds = 60.0 if service == "stalling" else 20.0  # in which p99 is no chance
    calm, calm_shares = at_thirty_percent(worlds, seconds)
    waiting, before = [], [len(world.answers) for world in worlds]
    for _ in range(2):
        offered(worlds, 1.5, 5.0)
        waiting.append(sum(world.dispatcher.waiting for world in worlds))
    assert waiting[1] < 1.2 * waiting[0]
    got = [len(world.answers) - n for world, n in zip(worlds, before, strict=True)]
    assert max(got) <= 1.1 * min(got)
    assert needed(worlds) <= {5, 6, 7}  # of 4.5 each would be full
    offered(worlds, 0.3, 5.0)
    after, shares = at_thirty_percent(worlds, seconds)
    assert needed(worlds) == {0}
    assert percentile(after, 50) < 1.1 * percentile(calm, 50)
    if robots == 1:  # it still knows what takes unusually long
        assert percentile(after, 99) < 1.5 * percentile(calm, 99)
    assert shares == pytest.approx(calm_shares, abs=0.1)


def needed(worlds) -> set[int]:
    """Return how many replicas would be enough, as robots say: 0 where there are."""
    return {world.dispatcher.report()["needed_replicas"] for world in worlds}


def at_thirty_percent(worlds, seconds: float) -> tuple[list[float], list[float]]:
    """Return how long requests took for a while, and each replica's share of the work."""
    asked = [len(world.asked) for world in worlds]
    before = [link.replica.service.ran for link in worlds[0].links]
    offered(worlds, 0.3, seconds)
    worlds[0].run(0.5)
    ran = [link.replica.service.ran - n for link, n in zip(worlds[0].links, before, strict=True)]
    took = [s for world, n in zip(worlds, asked, strict=True) for s in world.latencies(n)]
    assert len(took) == sum(len(world.asked) for world in worlds) - sum(asked)
    return took, [n / sum(ran) for n in ran]


@pytest.mark.parametrize("mode", [AUTO, FAILOVER])
def test_what_a_full_replica_refuses_the_next_has_at_once(mode):
    world = World(mode, timeout_s=1.0)
    for _ in range(2):
        world.replica(SERVICES["constant"], serial=True)

    def refuse(incoming: SimulatedIncoming) -> None:
        incoming.refuse(Refusal.OVERLOADED, load=Load(50, 1, 1, 0.02, 0.0))

    world.links[0].replica.responder.request = refuse  # type: ignore[method-assign]
    world.poisson(20.0, 10.0, random.Random(1))
    world.run(1.0)
    assert lost([world]) == 0
    assert world.dispatcher.report()["refused"]["overloaded"] > 0
    alone = World(mode, timeout_s=1.0)
    alone.replica(SERVICES["constant"], serial=True)
    alone.poisson(20.0, 10.0, random.Random(1))
    alone.run(1.0)
    longer_s = max(map(operator.sub, world.latencies(), alone.latencies()))
    assert longer_s < 0.005  # the way there and back, and the request before it


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
