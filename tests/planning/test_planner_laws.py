"""The planner's safety laws, for any world that can be made up."""

from __future__ import annotations

import contextlib
import random
from dataclasses import replace

import hypothesis
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fogft.model.reason import Cause
from fogft.model.replica import LinkState, MachinePhase, ReplicaId
from fogft.planning.planner import Plan
from tests.nightly import by_day
from tests.planning.pool_worlds import (
    OFFERS,
    STRANGER,
    UID,
    World,
    applied,
    counted,
    elapsed,
    serving,
    worlds,
)

many = settings(
    max_examples=by_day(30, at_night=300),
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)


def needed(world: World, planned: Plan, leaving: set[ReplicaId]) -> int:
    """Return how many have to go on serving: one fewer where an outdated one makes room."""
    outdated = {m.id for m in world.machines or () if m.spec_hash == "old"}
    makes_room = any(note.cause is Cause.OLD_BEFORE_NEW for note in planned.notes)
    if makes_room and leaving & outdated:
        return max(1, planned.wanted - 1)
    return planned.wanted


@many
@given(worlds())
def test_never_more_than_spec_and_surge(world: World) -> None:
    """No plan launches beyond the wanted replicas and the surge, counting what there is."""
    planned = world.plan()
    if planned.launches:
        live = len(counted(world, world.machines or ())) + len(planned.launches)
        assert live <= planned.wanted + world.spec.max_surge


@many
@given(worlds())
def test_needed_ready_replica_is_never_ended(world: World) -> None:
    """Who serves is ended only if as many others as are wanted go on serving."""
    planned = world.plan()
    ends = {end.id for end in planned.terminations}
    ready = serving(world) - world.ending
    noticed = {m.id for m in world.machines or () if m.notice}
    if ends & ready:
        assert len(ready - ends - noticed) >= needed(world, planned, ends & ready)


@many
@given(worlds())
def test_needed_ready_replica_is_never_drained(world: World) -> None:
    """Who serves is marked to go only if enough others, unmarked, go on serving."""
    planned = world.plan()
    ends = {end.id for end in planned.terminations}
    noticed = {m.id for m in world.machines or () if m.notice}
    left = serving(world) - world.ending - ends - noticed - set(planned.draining)
    if planned.draining:
        marked = {id for id in planned.draining if id in serving(world)}
        assert len(left) >= needed(world, planned, marked)


@many
@given(worlds())
def test_only_machines_of_our_uid_are_ended(world: World) -> None:
    """A stranger's machine in the list is not ours to touch, stopping or not."""
    stopping = replace(world, intent=replace(world.intent, stopping=True))
    for planned in (world.plan(), stopping.plan()):
        touched = {end.id for end in planned.terminations} | set(planned.draining)
        assert not {id for id in touched if id.pool_uid == STRANGER}


@many
@given(worlds())
def test_generation_is_never_reused(world: World) -> None:
    """A launch's generation is above every one that the history or the cloud knows."""
    planned = world.plan()
    assert len({launch.slot for launch in planned.launches}) == len(planned.launches)
    for launch in planned.launches:
        assert launch.generation > world.history.generations[launch.slot]
        listed = [
            m.id.generation for m in world.machines or () if m.id.slot == launch.slot
            and m.id.pool_uid == UID
        ]  # fmt: skip
        assert launch.generation > max(listed, default=0)


@many
@given(worlds())
def test_plan_under_way_leaves_nothing_to_plan(world: World) -> None:
    """Planning again while a plan is carried out orders nothing more."""
    planned = world.plan()
    under_way = applied(world, planned)
    again = under_way.plan()
    assert not again.launches
    assert not again.terminations
    assert set(again.draining) == set(planned.draining)


@many
@given(worlds())
def test_what_a_plan_orders_it_does_not_end(world: World) -> None:
    """A plan is planned on again until nothing is added; it never undoes what it has ordered."""
    planned = world.plan()
    ordered = {ReplicaId(UID, launch.slot, launch.generation) for launch in planned.launches}
    ends = [end.id for end in planned.terminations]
    assert not ordered & {*ends, *planned.draining}
    assert len(ends) == len(set(ends))
    assert not set(ends) & set(planned.draining)


@many
@given(worlds())
def test_budget_and_exclusions_hold_for_every_launch(world: World) -> None:
    """No launch exceeds `max_usd_per_hour` at today's prices; none goes to an excluded location."""
    planned = world.plan()
    cap = world.spec.max_usd_per_hour
    dearest_first = sorted(world.offers, key=lambda offer: -offer.usd_per_hour)
    today = {offer.placement: offer.usd_per_hour for offer in dearest_first}
    ours = [m for m in world.machines or () if m.id.pool_uid == UID]
    spent = sum(today.get(m.placement, m.usd_per_hour) for m in ours)
    if planned.launches and cap is not None:
        assert spent + sum(launch.offer.usd_per_hour for launch in planned.launches) <= cap + 1e-6
    for launch in planned.launches:
        assert not world.intent.is_excluded(launch.offer.placement.location)


@many
@given(worlds())
def test_unknown_cloud_changes_nothing(world: World) -> None:
    """Cannot tell is never gone: without the cloud's list nothing is launched or ended."""
    planned = replace(world, machines=None).plan()
    assert not planned.launches
    assert not planned.terminations
    assert planned.notes


@many
@given(worlds(links_known=True), st.floats(2.5, 100_000))
def test_all_silent_replaces_nothing(world: World, silent_s: float) -> None:
    """When every link that ever answered is silent, no listed replica is replaced or ended.

    A further stand-in may be called for all the same: beside one that boots in a lost one's place.
    """
    links = tuple(
        replace(link, state=LinkState.SUSPECT, ready=frozenset(), silent_for_s=silent_s)
        for link in world.links or ()
    )
    machines = tuple(
        replace(m, notice=False, spec_hash=world.spec.replica_hash)
        for m in world.machines or ()
        if m.phase is MachinePhase.RUNNING
    )
    ours = [m for m in machines if m.id.pool_uid == UID and m.id not in world.ending]
    if len(ours) < 2:
        return
    intent = replace(world.intent, drained={}, excluded=frozenset())
    before = replace(world, machines=machines, intent=intent)
    planned = replace(before, links=links).plan()
    assert planned.health is not None
    assert planned.health.uplink_suspected
    assert not planned.terminations
    assert not planned.draining
    more = 1 if world.spec.on_demand.fallback else 0
    known = len(before.plan().launches)
    assert len(planned.launches) <= max(planned.wanted - len(ours), known) + more


@many
@given(worlds(), st.integers())
def test_order_of_what_is_observed_does_not_matter(world: World, seed: int) -> None:
    """The same facts in another order give the same plan."""
    shuffled = list(world.machines or ()), list(world.links or ()), list(world.offers)
    for part in shuffled:
        random.Random(seed).shuffle(part)
    other = replace(
        world,
        machines=tuple(shuffled[0]),
        links=None if world.links is None else tuple(shuffled[1]),
        offers=tuple(shuffled[2]),
    )
    assert other.plan() == world.plan()


@many
@given(worlds(links_known=True))
def test_pool_settles_and_stays_settled(world: World) -> None:
    """Without further faults, room to surge and offers, plans lead to a whole and quiet pool."""
    world = replace(
        world,
        spec=replace(
            world.spec,
            max_surge=max(1, world.spec.max_surge),
            max_usd_per_hour=None,
        ),
        offers=OFFERS,
        intent=replace(world.intent, excluded=frozenset()),
        links=tuple(
            link if link.ready or link.state is not LinkState.UP else replace(link, ready=_ALL)
            for link in world.links or ()
        ),
    )
    # One that answers, so that silence counts.
    witness = [
        m for m in world.machines or () if m.id in serving(world) - world.ending and not m.notice
    ]
    if not witness:
        world = replace(world, machines=(), links=())
    # Replicas move again when what was avoided or at rest is forgiven, and when they have stayed.
    for seconds in (*[15.0] * 20, *[700.0] * 6, *[15.0] * 6, *[4000.0] * 14, *[15.0] * 14):
        planned = world.plan()
        world = elapsed(applied(world, planned), seconds)
    planned = world.plan()
    assert not planned.launches
    assert not planned.terminations
    ours = [m for m in world.machines or () if m.id.pool_uid == UID]
    assert len(ours) == planned.wanted
    assert all(m.id in serving(world) for m in ours)
    assert all(m.spec_hash == world.spec.replica_hash for m in ours)


_ALL = frozenset({"/plan"})


class Enough(Exception):
    """Everything has been seen."""


def test_the_strategy_reaches_what_it_should() -> None:
    """Guards the laws above against worlds in which nothing ever happens."""
    wanted = dict.fromkeys(
        ("launches", "terminations", "draining", "ends a serving one", "uplink", "budget", "surge"),
        False,
    )

    @hypothesis.seed(2)  # one that soon reaches all
    @settings(
        max_examples=3000, database=None, phases=[hypothesis.Phase.generate],
        report_multiple_bugs=False,
    )  # fmt: skip
    @given(worlds())
    def look(world: World) -> None:
        planned = world.plan()
        causes = {why.cause for note in planned.notes for why in (note, *note.because)}
        hits = {
            "launches": planned.launches,
            "terminations": planned.terminations,
            "draining": planned.draining,
            "ends a serving one": {e.id for e in planned.terminations} & serving(world),
            "uplink": planned.health is not None and planned.health.uplink_suspected,
            "budget": Cause.OVER_BUDGET in causes,
            "surge": Cause.SURGE_FULL in causes,
        }
        wanted.update((name, True) for name, hit in hits.items() if hit)
        if all(wanted.values()):
            raise Enough

    with contextlib.suppress(Enough):
        look()
    assert all(wanted.values()), wanted
