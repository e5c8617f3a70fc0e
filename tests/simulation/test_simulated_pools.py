"""Simulated pools: time, money and laws of chance come out as arithmetic says they must."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from fogft.model.choices import OnDemandSpec, ScheduleSpec, WindowSpec
from fogft.planning import planner
from fogft.planning.observed.history import EventKind
from fogft.simulation.comparison import (
    SETTLE_S,
    Row,
    compare,
    estimate,
    policies,
    unlogged,
)
from fogft.simulation.market import Market
from fogft.simulation.model import MarketModel, Timing
from fogft.simulation.report import simulate_scenario
from fogft.simulation.timeline import PER_USD, UNLIMITED, of_changes, of_samples
from fogft.simulation.world import World
from tests.needs import needs
from tests.nightly import by_day
from tests.simulation.arithmetic import moving, staying
from tests.simulation.markets import INDEPENDENT, EveryTick, any_scenario, scenario, spec

HOUR_S = 3600.0
EVERY_DAY = frozenset(range(7))


def managed(world, wanted):
    """Return fogft's policy in a world."""
    return policies(wanted)["fogft"](world)


def run(wanted, policy="fogft", seed=0, asked=lambda policy: policy):
    """Run one policy in one market; return the policy and its meter."""
    world = World(wanted.market(seed), seed=seed, length_s=wanted.length_s, settle_s=SETTLE_S)
    chosen = policies(wanted)[policy](world)
    with unlogged():
        meter = world.run(asked(chosen))
    return chosen, meter


def always(wanted):
    """The same scenario, with room everywhere at all times."""
    length_s = wanted.length_s
    places = wanted.market(0).timelines
    return replace(wanted, recorded={p: of_samples([UNLIMITED], length_s) for p in places})


# -- a quiet market ---------------------------------------------------------------------------


def test_a_pool_that_nothing_happens_to_costs_its_machines_and_is_always_up():
    policy, meter = run(always(scenario(spec(2))))
    outcome = meter.outcome()
    launches = [e for e in policy.store.events if e.kind is EventKind.LAUNCH]
    assert (outcome.available, outcome.under_target, outcome.outages) == (1.0, 0.0, 0)
    assert len(launches) == 2
    offered = {
        o.placement.location: o.usd_per_hour for o in policy.world.offers({"use_spot": True})
    }
    assert outcome.usd_per_hour == pytest.approx(sum(offered[e.location] for e in launches))
    assert outcome.seconds == pytest.approx(86_400.0)


@pytest.mark.parametrize(("notice_s", "outages"), [(0.0, 1), (400.0, 0)])
def test_a_loss_costs_a_boot_and_its_detection_unless_it_was_announced(notice_s, outages):
    """One replica; its zone is lost once. A notice longer than a boot hides it."""
    timing = Timing(boot_s=240.0, notice_s=notice_s, detect_s=5.0)
    wanted = always(scenario(spec(1), timing=timing))
    lost = of_changes([(0, UNLIMITED), (4 * HOUR_S, 0), (5 * HOUR_S, UNLIMITED)], wanted.length_s)
    first = run(wanted)[0].store.events[0].location
    outcome = run(replace(wanted, recorded={**wanted.recorded, first: lost}))[1].outcome()
    assert (outcome.outages, outcome.available < 1) == (outages, bool(outages))
    if outages:
        assert 0.75 * 240 <= outcome.longest_outage_s <= 1.25 * 240 + 5 + 2


# -- the real planner's rules, as they come out ------------------------------------------------


@pytest.mark.parametrize("seed", range(by_day(1, at_night=20)))
def test_asking_only_when_something_can_change_changes_nothing(seed):
    """The same events as when the manager looks every second, as it does in real life.

    In markets and for pools by seed: `python -m tests.simulation.looks` tries as many as one likes.
    """
    wanted = any_scenario(seed)
    jumping, lazily = run(wanted, seed=seed)
    ticking, eagerly = run(wanted, seed=seed, asked=EveryTick)
    assert jumping.world.asked < ticking.world.asked / 4
    assert jumping.store.events == ticking.store.events
    assert lazily.outcome().available == pytest.approx(eagerly.outcome().available)
    assert lazily.outcome().usd_per_hour == pytest.approx(eagerly.outcome().usd_per_hour)


@pytest.mark.parametrize("seed", range(by_day(1, at_night=20)))
def test_planning_on_adds_nothing_to_a_plan_that_is_said_to_be_closed(seed, monkeypatch):
    """The same events as when each plan that changes anything is planned on while under way."""
    wanted = any_scenario(seed, days=0.2)
    trusting = run(wanted, seed=seed)[0].store.events
    once = planner.plan_once
    doubted = lambda *args, **options: once(*args, **options)._replace(closed=False)  # noqa: E731
    monkeypatch.setattr(planner, "plan_once", doubted)
    assert run(wanted, seed=seed)[0].store.events == trusting


def test_a_pool_is_whole_when_its_window_opens():
    """Prelaunched: in four days never under target, with four wanted by day and one by night."""
    day = WindowSpec(EVERY_DAY, 8 * 3600, 18 * 3600, replicas=4)
    ahead = spec(1, schedule=ScheduleSpec("UTC", (day,), prelaunch_s=600.0))
    late = spec(1, schedule=ScheduleSpec("UTC", (day,), prelaunch_s=0.0))
    outcomes = [run(always(scenario(s, days=4.0)))[1].outcome() for s in (ahead, late)]
    assert outcomes[0].under_target == 0.0
    assert outcomes[1].under_target > 0.0
    assert outcomes[0].mean_ready == pytest.approx((4 * 10 + 14) / 24, rel=0.03)


def test_while_no_replica_is_wanted_nothing_is_an_outage():
    night = WindowSpec(EVERY_DAY, 20 * 3600, 6 * 3600, replicas=0)
    pool = spec(2, schedule=ScheduleSpec("UTC", (night,), prelaunch_s=900.0))
    outcome = run(always(scenario(pool, days=3.0)))[1].outcome()
    assert (outcome.available, outcome.outages, outcome.longest_outage_s) == (1.0, 0, 0.0)
    assert outcome.mean_ready == pytest.approx(2 * 14 / 24, rel=0.05)


def test_the_budget_holds_at_every_moment():
    pool = spec(4, max_usd_per_hour=0.25)
    wanted = scenario(pool, days=2.0)
    world = World(wanted.market(0), seed=0, length_s=wanted.length_s)
    spent = []
    policy = managed(world, wanted)
    ask = policy.tick

    def tick(now):
        out = ask(now)
        spent.append(sum(vm.order.usd_per_hour for vm in world.vms.values()))
        return out

    policy.tick = tick
    with unlogged():
        world.run(policy)
    assert 0.2 < max(spent) <= 0.25 + 1e-9


# -- arithmetic --------------------------------------------------------------------------------


@pytest.mark.parametrize("replicas", [1, 2, pytest.param(3, marks=needs("night"))])
def test_without_correlation_the_product_of_unavailabilities_is_right(replicas):
    """`planning.reliability` for replicas that stay, against eight simulated months."""
    wanted = scenario(
        spec(replicas), model=INDEPENDENT, timing=Timing(boot_s=0.0, answer_s=1.0, detect_s=1.0),
        days=40.0,
    )  # fmt: skip
    rows = [run(wanted, f"static, any of {replicas}", seed=s)[1].outcome() for s in range(6)]
    down = 1 - sum(o.available for o in rows) / len(rows)
    # A refused place is tried again after a minute, half of it lost on average.
    one = staying(INDEPENDENT, Timing(boot_s=30.0))
    assert down == pytest.approx(math.prod([one] * replicas), rel=0.15)


def test_without_correlation_a_replica_that_moves_is_down_as_reckoned():
    """P = recovery / (uptime + recovery), as long as some place has room."""
    timing = Timing(boot_s=600.0, notice_s=0.0)
    wanted = scenario(spec(1, migration=False), model=INDEPENDENT, timing=timing, days=60.0)
    rows = [run(wanted, seed=seed)[1].outcome() for seed in range(4)]
    down = 1 - sum(o.available for o in rows) / len(rows)
    assert down == pytest.approx(moving(INDEPENDENT, timing), rel=0.15)


def test_with_correlation_independence_promises_too_much():
    """Two that stay, correlation 0.4: twice as often down together as independent ones."""
    model = replace(
        INDEPENDENT, correlation_region=0.4, correlation_cloud=0.4, correlation_world=0.4
    )
    timing = Timing(boot_s=0.0, answer_s=1.0, detect_s=1.0)
    wanted = scenario(spec(2), model=model, timing=timing, days=60.0)
    seeds = range(by_day(3, at_night=6))
    rows = [run(wanted, "static, any of 2", seed=seed)[1].outcome() for seed in seeds]
    down = 1 - sum(o.available for o in rows) / len(rows)
    one = staying(model, Timing(boot_s=30.0))
    assert down > 1.8 * math.prod([one] * 2)
    assert down == pytest.approx(one * one + 0.4 * one * (1 - one), rel=0.2)


# -- comparison --------------------------------------------------------------------------------


def test_policies_meet_the_same_markets_and_the_same_seeds_give_the_same_report():
    wanted = scenario(spec(2), days=0.5, seeds=(3, 4))
    first, second = simulate_scenario(wanted).to_json(), simulate_scenario(wanted).to_json()
    assert first == second
    assert [row["policy"] for row in first["policies"]] == [
        "fogft",
        "one on-demand",
        "static, any of 2",
        "SkyServe, spot only",
        "SkyServe, fallback",
        "SpotHedge",
        "naive",
        "round robin",
        "omniscient",
    ]
    assert first != simulate_scenario(replace(wanted, seeds=(5, 6))).to_json()


def test_an_on_demand_machine_costs_its_price_and_never_stops():
    rows = {row.name: row for row in compare(scenario(spec(2), days=1.0))}
    outcome = rows["one on-demand"].outcomes[0]
    assert (outcome.available, outcome.under_target, outcome.launches) == (1.0, 1.0, 0)
    assert outcome.usd_per_hour == pytest.approx(0.192)


def test_skyserve_falls_back_to_on_demand_where_spot_is_gone():
    wanted = scenario(spec(2), days=1.0)
    nothing = {p: of_samples([0], wanted.length_s) for p in wanted.market(0).timelines}
    rows = {row.name: row.outcomes[0] for row in compare(replace(wanted, recorded=nothing))}
    assert rows["SkyServe, fallback"].available == 1.0
    assert rows["SkyServe, fallback"].usd_per_hour == pytest.approx(2 * 0.192)
    assert rows["SkyServe, spot only"].available == 0.0
    assert rows["static, any of 2"].available == 0.0
    assert rows["fogft"].available == 0.0


def test_on_demand_stands_in_where_spot_is_gone_and_leaves_when_it_is_back():
    """No spot anywhere from hour 6 to 12: answered all the time but while both boot."""
    pool = spec(2, on_demand=OnDemandSpec(fallback=True))
    wanted = scenario(pool, days=1.0, timing=Timing(notice_s=0.0))
    short = of_changes([(0, UNLIMITED), (6 * HOUR_S, 0), (12 * HOUR_S, UNLIMITED)], wanted.length_s)
    recorded = dict.fromkeys(wanted.market(0).timelines, short)
    policy, meter = run(replace(wanted, recorded=recorded))
    outcome = meter.outcome()
    assert outcome.outages == 1
    assert outcome.longest_outage_s < 900
    assert all(vm.order.placement.spot and vm.ready for vm in policy.world.vms.values())


def test_an_on_demand_machine_may_fail():
    wanted = scenario(spec(1), days=30.0, timing=Timing(on_demand_mttf_s=5 * 86_400.0))
    outcome = run(wanted, "one on-demand")[1].outcome()
    assert outcome.preemptions > 2
    assert 0.98 < outcome.available < 1.0


def test_refused_on_demand_machines_are_asked_for_again():
    wanted = scenario(spec(1), days=1.0, timing=Timing(on_demand_refused=0.5))
    outcomes = [run(wanted, "one on-demand", seed)[1].outcome() for seed in range(8)]
    assert all(outcome.available == 1.0 for outcome in outcomes)  # after the first hour
    often = Timing(on_demand_mttf_s=3600.0, on_demand_refused=0.5)
    outcome = run(scenario(spec(1), days=9.0, timing=often), "one on-demand")[1].outcome()
    assert outcome.refusals > outcome.launches / 2


@pytest.mark.parametrize(
    ("timing", "more"), [(Timing(launch_fails=0.5), 1.2), (Timing(slow_setup=0.5), 0.8)]
)
@pytest.mark.parametrize("policy", ["fogft", "naive"])
def test_machines_that_were_accepted_and_serve_late_or_never_are_replaced(policy, timing, more):
    pool = spec(2, on_demand=OnDemandSpec(fallback=True))
    usual = scenario(pool, days=5.0)
    failing = replace(usual, timing=timing)
    good, bad = (run(one, policy)[1].outcome() for one in (usual, failing))
    assert bad.launches > more * good.launches
    assert bad.under_target > good.under_target
    assert bad.available > 0.98


def test_no_region_has_more_spot_machines_than_the_quota():
    """Room everywhere, six wanted, and one in each of the local cloud's regions."""
    pool = spec(6, on_demand=OnDemandSpec(fallback=True))
    wanted = always(scenario(pool, days=0.2, timing=Timing(spot_quota=1.0)))
    chosen, _ = run(wanted)
    spot = [vm.order.placement for vm in chosen.world.vms.values() if vm.order.placement.spot]
    regions = {place.domains[1] for place in spot}
    assert len(regions) == len(spot) > 1


def test_machines_cost_what_the_hour_costs():
    """From hour 13 on all spot prices are the double: so is the bill."""
    steady = always(scenario(spec(2, migration=False), days=1.0))
    offers = steady.find({"use_spot": True})
    prices = {
        offer.placement.location: of_changes(
            [(0, round(PER_USD * usd)), (13 * HOUR_S, round(2 * PER_USD * usd))], 26 * HOUR_S
        )
        for offer in offers
        for usd in [offer.usd_per_hour]
    }
    before = run(steady)[1].outcome().usd_per_hour
    assert run(replace(steady, prices=prices))[1].outcome().usd_per_hour == pytest.approx(
        1.5 * before, rel=0.01
    )


@pytest.mark.parametrize("replicas", [1, 2])
def test_a_region_that_has_become_dear_is_left(replicas):
    """Three times the price from the sixth hour on, in all zones of the first replica's region."""
    steady = always(scenario(spec(replicas), days=1.0))
    chosen, _ = run(steady)
    region = next(iter(chosen.world.vms.values())).order.placement.region
    sold = [o for o in steady.find({"use_spot": True}) if o.placement.region == region]
    prices = {
        offer.placement.location: of_changes(
            [(0, round(PER_USD * usd)), (6 * HOUR_S, round(3 * PER_USD * usd))], 26 * HOUR_S
        )
        for offer in sorted(sold, key=lambda o: -o.usd_per_hour)
        for usd in [offer.usd_per_hour]
    }
    moved, _ = run(replace(steady, prices=prices))
    places = [vm.order.placement for vm in moved.world.vms.values()]
    assert len(places) == replicas
    assert region not in {place.region for place in places}


@pytest.mark.parametrize(
    ("hours", "of"), [(48, "boot times"), (73, "whole days drawn anew (block bootstrap)")]
)
def test_recorded_traces_shorter_than_asked_are_used_whole(hours, of):
    """Room on every other day alone: the interval of availability is that of days."""
    wanted = scenario(spec(1), days=5.0)
    samples = [int(hour // 24 != 1) for hour in range(hours)]
    lines = {p: of_samples(samples, HOUR_S) for p in wanted.market(0).timelines}
    report = simulate_scenario(replace(wanted, recorded=lines))
    assert report.scenario.days == pytest.approx((hours - 1) / 24)
    assert report.notes == (
        f"the traces cover {(hours - 1) / 24:.1f} days after the first hour: all are used",
        f"every seed replays the same days; intervals are of {of}",
    )
    row = report.rows[0]
    found, seconds = row.estimate("available"), sum(o.seconds for o in row.outcomes)
    assert found.mean == pytest.approx(sum(o.available * o.seconds for o in row.outcomes) / seconds)
    assert (found.high - found.low > 0.5) is row.same_days


def test_boots_that_the_pool_file_does_not_wait_for_are_told():
    wanted = scenario(spec(1), days=0.1, timing=Timing(boot_s=900.0))
    assert (
        "some boots take longer than `health.start_limit_s` (900 s)"
        in simulate_scenario(wanted).notes[0]
    )


def test_recorded_numbers_are_room_for_so_many_machines():
    """Two replicas and room for one in the only zone with a trace: one serves."""
    wanted = scenario(spec(2), days=1.0)
    place = sorted(wanted.market(0).timelines)[0]
    outcome = run(replace(wanted, recorded={place: of_samples([1], wanted.length_s)}))[1].outcome()
    assert (outcome.available, outcome.under_target) == (1.0, 1.0)
    assert outcome.mean_ready == pytest.approx(1.0)
    assert outcome.refusals > 0


def test_an_interval_holds_the_mean_and_narrows_with_seeds():
    few, many = estimate([0.0, 1.0] * 3), estimate([0.0, 1.0] * 60)
    assert few.low < few.mean == many.mean == 0.5 < few.high
    assert many.high - many.low < few.high - few.low
    assert estimate([0.3]).low == estimate([0.3]).high == 0.3


def test_a_day_is_a_market_s_unit():
    meter = run(scenario(spec(1), model=MarketModel(), days=2.0))[1]
    row = Row("x", (meter.outcome(),))
    assert row.estimate("launches_per_day").mean == meter.launches / 2
    assert isinstance(Market(lambda resources: [], {}).offers({}), list)
