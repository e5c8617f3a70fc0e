"""Rules of placement, size, mixture and migration, for pools that live through simulated days."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fogft.model.choices import (
    MAX_REPLICAS,
    AvailabilitySpec,
    GroupSpec,
    OnDemandSpec,
    PlacementSpec,
    ScheduleSpec,
    WindowSpec,
)
from fogft.model.groups import BLOCK, overridden
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Offer, Placement
from fogft.model.spec import PoolSpec
from fogft.planning import migration
from fogft.planning.availability import Assumption, Correlation, expected
from fogft.planning.observed.history import Event, EventKind
from tests.nightly import by_day
from tests.planning.pool_worlds import (
    NOW,
    UID,
    World,
    applied,
    elapsed,
    replica,
    serving,
    spec,
)

some = settings(
    max_examples=by_day(20, at_night=500),
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
MIXED = OnDemandSpec(0, True)


def offer(place: str, price: float, *, spot: bool = True, group: str = "") -> Offer:
    cloud, region, zone = place.split("/")
    kind = "s" if spot else "d"
    return Offer(Placement(cloud, region, zone, kind, spot), price, group=group)


SPOT = tuple(offer(p, 0.1) for p in ("a/r/1", "a/r/2", "b/r/1"))
ON_DEMAND = tuple(offer(p, 0.3, spot=False) for p in ("a/r/1", "b/r/1"))


def lived(world: World, steps: int, seconds: float = 30.0) -> tuple[World, int]:
    """Carry plans out for a while; return the world after, and how many launches there were."""
    launched = 0
    for _ in range(steps):
        planned = world.plan()
        launched += len(planned.launches)
        world = elapsed(applied(world, planned), seconds)
    return world, launched


def ours(world: World) -> list[Placement]:
    return [m.placement for m in world.machines or () if m.id.pool_uid == UID]


# -- spread and price ------------------------------------------------------------------------

offers = st.lists(
    st.tuples(
        st.sampled_from(["a", "b", "c"]), st.sampled_from(["r", "s"]), st.sampled_from(["1", "2"])
    ),
    min_size=1,
    unique=True,
).flatmap(
    lambda places: st.tuples(
        *(st.floats(0.05, 1).map(lambda price, p=p: offer("/".join(p), price)) for p in places)
    )
)


@some
@given(offers, st.integers(2, 6), st.none() | st.floats(0.2, 3))
def test_never_all_in_one_domain_when_another_is_affordable(sold, count, cap):
    """Where replicas share one cloud (or region), no offer elsewhere was within the budget."""
    world = World(spec(count, max_usd_per_hour=cap), offers=sold)
    chosen = [launch.offer for launch in world.plan().launches]
    if len(chosen) < 2:
        return
    for domain in (lambda p: p.cloud, lambda p: (p.cloud, p.region)):
        used = {domain(o.placement) for o in chosen}
        if len(used) == 1:
            left = math.inf if cap is None else cap - chosen[0].usd_per_hour
            others = [o for o in sold if domain(o.placement) not in used]
            assert all(o.usd_per_hour > left + 1e-9 for o in others)


@some
@given(offers, st.integers(1, 6), st.floats(0.05, 3))
def test_a_pool_that_lives_never_exceeds_its_cap(sold, count, cap):
    world = World(spec(count, max_usd_per_hour=cap), offers=sold)
    for _ in range(6):
        world = elapsed(applied(world, world.plan()), 30.0)
        assert sum(m.usd_per_hour for m in world.machines or ()) <= cap + 1e-6


def test_distance_and_price_are_weighed():
    """Twice as far for a third of the price is worth it; with a heavier latency it is not."""
    near, far = offer("a/near/1", 0.30), offer("a/far/1", 0.10)
    rtt_s = {"a/near": 0.02, "a/far": 0.04}

    def first(weight: float) -> str:
        asked = spec(1, placement=PlacementSpec(weight))
        [launch] = World(asked, offers=(near, far), rtt_s=rtt_s).plan().launches
        return launch.offer.placement.region

    assert first(1.0) == "far"
    assert first(2.0) == "near"
    assert first(0.0) == "far"


@pytest.mark.parametrize("price", [-0.1, math.nan, math.inf])
def test_an_impossible_price_launches_nothing_there(price):
    wrong = offer("a/r/1", price)
    planned = World(spec(1), offers=(wrong,)).plan()
    assert not planned.launches
    assert planned.notes[0] == Reason(Cause.IMPOSSIBLE_PRICE, location="a/r/1")
    [launch] = World(spec(1), offers=(wrong, offer("b/r/1", 9.0))).plan().launches
    assert launch.offer.placement.cloud == "b"


def test_losses_make_a_location_dearer_and_are_forgiven():
    """Three within minutes outweigh a fifth of the price; a week later they do not."""
    cheap, dear = offer("a/r/1", 0.1), offer("a/r/2", 0.12)

    def chosen(losses: int, age_s: float) -> str:
        events = [
            e
            for n in range(losses)
            for e in (
                Event(NOW - age_s - 200, EventKind.LAUNCH, 7, n + 1, "a/r/1"),
                Event(NOW - age_s - 100, EventKind.READY, 7, n + 1),
                Event(NOW - age_s, EventKind.GONE, 7, n + 1),
            )
        ]
        world = World(spec(1), offers=(cheap, dear), events=tuple(events))
        [launch] = world.plan().launches
        return launch.offer.placement.zone

    assert [chosen(losses, 7200) for losses in (0, 3)] == ["1", "2"]
    assert chosen(3, 7 * 86_400) == "1"


# -- availability ----------------------------------------------------------------------------


@some
@given(offers, st.floats(0.5, 0.99999), st.floats(0, 0.3))
def test_a_target_is_reached_by_no_more_than_it_needs(sold, target, correlation):
    """The planned pool reaches the target and one fewer does not; or the note says it cannot."""
    assumed = Assumption(correlation=Correlation(0.5, 0.3, correlation))
    asked = spec(1, availability=AvailabilitySpec(target=target, correlation=assumed.correlation))
    planned = World(asked, offers=sold).plan()
    places = [launch.offer.placement for launch in planned.launches]
    sold = [offer.placement for offer in sold if offer.placement.spot]
    reached = expected(places, assumed, sold).correlated
    if any(note.cause is Cause.TARGET_UNMET for note in planned.notes):
        assert reached < target
        assert planned.wanted <= MAX_REPLICAS
    elif len(places) == planned.wanted:  # not 12 now and the others within the hour
        assert reached >= target - 1e-9
        assert len(places) == 1 or expected(places[:-1], assumed, sold).correlated < target


def test_a_target_out_of_reach_within_the_cap_says_what_the_money_buys():
    rich = AvailabilitySpec(target=0.99999, no_room=0.0)
    asked = spec(1, availability=rich, max_usd_per_hour=0.25)
    planned = World(asked, offers=SPOT).plan()
    assert len(planned.launches) == 2
    [note] = [n for n in planned.notes if n.cause is Cause.TARGET_UNMET]
    assert (note.count, note.target) == (2, 0.99999)
    assert note.share == pytest.approx(0.99, abs=0.01)
    assert note.because == (Reason(Cause.OVER_CAP),)


def test_where_all_locations_are_full_together_the_plan_says_so():
    """No number of spot machines is up while none can be had: on-demand ones bridge it."""
    asked = spec(1, availability=AvailabilitySpec(target=0.9995))
    [note] = [n for n in World(asked, offers=SPOT).plan().notes if n.cause is Cause.TARGET_UNMET]
    [why] = note.because
    assert why.cause is Cause.FULL_TOGETHER
    assert why.share is not None
    assert why.share > 0.0005
    bridged = replace(asked, on_demand=OnDemandSpec(0, fallback=True))
    assert World(bridged, offers=SPOT).plan().wanted == 2


def test_two_clouds_need_fewer_than_one():
    """Correlation within a cloud costs replicas; the paper's independent figure is 2."""
    asked = spec(1, availability=AvailabilitySpec(target=0.9995, no_room=0.0))
    one_cloud = tuple(o for o in SPOT if o.placement.cloud == "a")
    few = World(asked, offers=one_cloud).plan()  # two zones of one region: no number is enough
    [note] = [n for n in few.notes if n.cause is Cause.TARGET_UNMET]
    assert few.wanted == note.count == 2
    assert World(asked, offers=SPOT).plan().wanted == 2


def test_a_target_does_not_shrink_while_nothing_is_offered():
    asked = spec(1, availability=AvailabilitySpec(target=0.9995))
    world = World(asked, offers=()).having(*(replica(n, of=asked) for n in range(4)))
    assert world.plan().wanted == 4
    assert not world.plan().draining


# -- groups, on-demand -------------------------------------------------------------------------

GROUPS = (
    GroupSpec("anchor", 1, {"cpus": 4}),
    GroupSpec("fast", 2, {"cpus": 16, "use_spot": True}, MIXED),
)


def test_a_groups_own_place_replaces_every_place_of_the_file():
    shared = {"use_spot": True, "any_of": [{"infra": "aws", "cpus": 2}, {"cloud": "gcp"}]}
    kept = {"use_spot": True, "any_of": [{"cpus": 2}, {}]}
    assert overridden(shared, {"infra": "oci"}) == {**kept, "infra": "oci"}
    assert overridden({"infra": "aws"}, {"cloud": "gcp"}) == {"cloud": "gcp"}
    assert overridden(shared, {"cpus": 4}) == {**shared, "cpus": 4}
    west = {"region": "us-west-2"}
    assert overridden({"cloud": "aws", "region": "a", "zone": "aa"}, west) == {
        "cloud": "aws",
        **west,
    }
    listed = {"any_of": [{"infra": "aws/a", "cpus": 2}, {"infra": "*/a"}]}
    assert overridden(listed, west) == {"any_of": [{"cpus": 2, "cloud": "aws"}, {}], **west}


def test_each_group_gets_its_own_kind_in_its_own_slots():
    sold = (
        *(replace(o, group="anchor") for o in ON_DEMAND),
        *(replace(o, group="fast") for o in SPOT),
    )
    planned = World(spec(3, groups=GROUPS), offers=sold).plan()
    assert [(x.slot, x.offer.group, x.offer.placement.spot) for x in planned.launches] == [
        (0, "anchor", False),
        (BLOCK, "fast", True),
        (BLOCK + 1, "fast", True),
    ]
    assert len({x.offer.placement.location for x in planned.launches[1:]}) == 2


def test_a_group_that_left_the_file_is_replaced_new_before_old():
    asked = spec(1)
    world = World(asked).having(replica(BLOCK, of=asked))
    planned = world.plan()
    assert [x.slot for x in planned.launches] == [0]
    assert not planned.terminations
    world, _ = lived(world, 6)
    assert [m.id.slot for m in world.machines or ()] == [0]


@some
@given(st.integers(0, 3), st.integers(1, 4), st.lists(st.booleans(), min_size=4, max_size=10))
def test_fallback_stands_in_within_the_target_and_gives_way(base, count, short):
    """On demand never exceeds what is wanted; when spot is back, only the base stays on demand."""
    base = min(base, count)
    asked = spec(count, on_demand=OnDemandSpec(base, True))
    world = World(asked)
    for is_short in short:
        sold = ON_DEMAND if is_short else (*SPOT, *ON_DEMAND)
        world, _ = lived(replace(world, offers=sold), 3, 300.0)
        on_demand = [p for p in ours(world) if not p.spot]
        assert base <= len(on_demand) <= count
        assert len(ours(world)) <= count + asked.max_surge
        assert len(serving(world)) >= count
    world, _ = lived(replace(world, offers=(*SPOT, *ON_DEMAND)), 30, 300.0)
    assert sorted(p.spot for p in ours(world)) == [False] * base + [True] * (count - base)


def test_fallback_keeps_to_the_cap():
    asked = spec(2, on_demand=MIXED, max_usd_per_hour=0.5)
    world, _ = lived(World(asked, offers=ON_DEMAND), 3)
    assert len(ours(world)) == 1


@pytest.mark.parametrize("cause", ["capacity", "quota"])
def test_where_spot_is_refused_on_demand_of_the_same_place_stands_in(cause):
    """A location at rest for spot machines is not at rest for on-demand ones, nor the reverse."""
    spot, demand = offer("a/r/1", 0.1), offer("a/r/1", 0.3, spot=False)
    mixed = spec(1, on_demand=OnDemandSpec(0, fallback=True))

    def refused(*, on_demand: bool) -> tuple[Event, ...]:
        launch = Event(NOW - 2, EventKind.LAUNCH, 0, 1, "a/r/1", on_demand=on_demand)
        return launch, Event(NOW - 1, EventKind.REFUSED, 0, 1, reason=Reason(Cause(cause)))

    for was_on_demand in (False, True):
        world = World(mixed, offers=(spot, demand), events=refused(on_demand=was_on_demand))
        [launch] = world.plan().launches
        assert launch.offer.placement.spot is was_on_demand


def test_without_fallback_nothing_stands_in():
    asked = spec(2, on_demand=OnDemandSpec(1, False))
    world, _ = lived(World(asked, offers=ON_DEMAND), 3)
    assert [p.spot for p in ours(world)] == [False]


# -- schedule --------------------------------------------------------------------------------


def with_window(replicas: int | None, cap: float | None) -> PoolSpec:
    # NOW is a Tuesday, 22:13:20 UTC.
    window = WindowSpec(frozenset(range(7)), 23 * 3600, 24 * 3600, replicas, cap)
    return spec(2, schedule=ScheduleSpec("UTC", (window,), 600.0))


def test_the_pool_is_whole_when_its_window_opens_and_shrinks_after():
    opens = NOW - 22 * 3600 - 13 * 60 - 20 + 23 * 3600
    opens -= (opens - NOW) // 86_400 * 86_400
    world, _ = lived(World(with_window(4, None), now=opens - 900), 3, 60.0)
    assert len(ours(world)) == 2
    world = replace(world, now=opens - 600)
    world, _ = lived(world, 3, 60.0)
    assert world.now < opens
    assert len(serving(world)) == 4
    world, _ = lived(replace(world, now=opens + 3600.0), 6, 30.0)
    assert len(ours(world)) == 2


def test_a_windows_number_holds_also_where_it_is_the_usual_one():
    """A target sets the number outside of it only."""
    opens = NOW - 22 * 3600 - 13 * 60 - 20 + 23 * 3600
    target = AvailabilitySpec(target=0.9995, no_room=0.0)
    asked = replace(with_window(1, None), replicas=1, availability=target)
    assert World(asked, offers=SPOT, now=opens + 60.0).plan().wanted == 1
    assert World(asked, offers=SPOT, now=opens - 10_000.0).plan().wanted == 2


def test_a_targets_number_is_launched_before_a_window_of_fewer_ends():
    window = WindowSpec(frozenset(range(7)), 20 * 3600, 22 * 3600 + 15 * 60, 1, None)  # in 100 s
    target = AvailabilitySpec(target=0.99999, no_room=0.0)
    asked = spec(2, schedule=ScheduleSpec("UTC", (window,), 600.0), availability=target)
    usual = World(asked, offers=SPOT, now=NOW + 200.0).plan().wanted
    assert usual > 2
    assert World(asked, offers=SPOT, now=NOW).plan().wanted == usual
    assert World(asked, offers=SPOT, now=NOW - 3600.0).plan().wanted == 1


def test_a_lower_cap_ends_the_dearest_and_keeps_one():
    asked = spec(3, max_usd_per_hour=0.25)
    dear = replica(0, price=0.3, of=asked)
    world = World(asked).having(dear, replica(1, of=asked), replica(2, of=asked))
    assert [id.short for id in world.plan().draining] == ["0.1"]
    world, _ = lived(world, 8)
    assert sorted(m.usd_per_hour for m in world.machines or ()) == [0.1, 0.1]
    lone = World(spec(1, max_usd_per_hour=0.01)).having(replica(0))
    assert not lone.plan().draining


# -- migration -------------------------------------------------------------------------------

OLD = 4000.0  # older than `STAY_S`


def settled(*sold: Offer, count: int = 1, **others: object) -> World:
    world, _ = lived(World(spec(count, **others), offers=sold), 4)
    return elapsed(world, OLD)


def test_a_replica_moves_to_a_much_cheaper_place_new_before_old():
    world = settled(offer("a/r/1", 0.2))
    world = replace(world, offers=(offer("a/r/1", 0.2), offer("a/r/2", 0.1)))
    planned = world.plan()
    [launch] = planned.launches
    assert launch.offer.placement.zone == "2"
    [why] = launch.reason.because  # half the price, and nothing is known of losses there
    assert (why.cause, why.share) == (Cause.BETTER_SCORE, pytest.approx(0.48, abs=0.005))
    assert not planned.draining
    for _ in range(5):
        world = elapsed(applied(world, world.plan()), 5.0)
        assert serving(world)
    assert [p.zone for p in ours(world)] == ["2"]


def test_a_nearer_place_moves_it_too():
    world = settled(offer("a/r/1", 0.1))
    sold = (offer("a/r/1", 0.1), offer("a/s/1", 0.1))
    world = replace(world, offers=sold, rtt_s={"a/r": 0.1, "a/s": 0.02})
    assert [x.offer.placement.region for x in world.plan().launches] == ["s"]


def test_only_one_moves_at_a_time():
    world = settled(offer("a/r/1", 0.2), offer("b/r/1", 0.2), count=2)
    cheap = (offer("a/r/2", 0.05), offer("b/r/2", 0.05))
    world = replace(world, offers=(*world.offers, *cheap))
    assert len(world.plan().launches) == 1
    assert not applied(world, world.plan()).plan().launches


def test_spread_is_restored_when_a_domain_comes_back():
    world = settled(offer("a/r/1", 0.1), count=2)
    world = replace(world, offers=(offer("a/r/1", 0.1), offer("b/r/1", 0.4)))
    world, launched = lived(world, 6)
    assert launched == 1
    assert {p.cloud for p in ours(world)} == {"a", "b"}


def refused(place: str, *ages_s: float, generation: int = 1) -> tuple[Event, ...]:
    """Launches of another slot that a location had no room for, so many seconds ago."""
    return tuple(
        event
        for number, age_s in enumerate(ages_s, generation)
        for event in (
            Event(NOW - age_s, EventKind.LAUNCH, 9, number, place),
            Event(NOW - age_s, EventKind.REFUSED, 9, number, reason=Reason(Cause.CAPACITY)),
        )
    )


def test_nobody_moves_to_where_there_was_no_room_within_an_hour():
    """A move is no need: a full place is asked again an hour later, and a launch is at once."""
    world = settled(offer("a/r/1", 0.2))
    at = world.now - NOW
    world = replace(world, offers=(offer("a/r/1", 0.2), offer("b/r/1", 0.02)))
    for age_s, moves in ((3500.0, 0), (3700.0, 1)):
        past = refused("b/r/1", age_s - at)
        events = tuple(sorted((*world.events, *past), key=lambda e: e.at))
        assert len(replace(world, events=events).plan().launches) == moves
    needy = replace(world, machines=(), links=(), events=refused("b/r/1", 3500.0 - at))
    assert [x.offer.placement.cloud for x in needy.plan().launches] == ["b"]


def test_where_all_rest_the_one_resting_longest_is_tried_once_a_minute():
    """Nobody waits for ten minutes when no location is left; one try at a time."""
    sold = (offer("a/r/1", 0.1), offer("b/r/1", 0.1))
    longest = refused("b/r/1", *range(300, 200, -10))  # ten times: rests for 600 s
    later = refused("a/r/1", *range(190, 90, -10), generation=11)
    world = World(spec(2), offers=sold, events=(*longest, *later))
    [launch] = world.plan().launches
    assert launch.offer.placement.cloud == "b"
    assert Reason(Cause.FAILED_LONGEST_AGO) in launch.reason.because
    again = replace(world, events=(*world.events, *refused("b/r/1", 59.0, generation=21)))
    assert not again.plan().launches
    quota = tuple(replace(e, reason=e.reason and Reason(Cause.QUOTA)) for e in world.events)
    assert not replace(world, events=quota).plan().launches


def test_migration_can_be_switched_off():
    world = settled(offer("a/r/1", 0.2), migration=False)
    world = replace(world, offers=(offer("a/r/1", 0.2), offer("b/r/2", 0.01)))
    assert not world.plan().launches


@some
@given(offers, st.integers(1, 4))
def test_with_steady_offers_moves_come_to_an_end(sold, count):
    """A pool started on a part of the offers ends up where nothing moves any more."""
    world = settled(*sold[: max(1, len(sold) // 2)], count=count)
    world, _ = lived(replace(world, offers=sold), 40, OLD)
    _, launched = lived(world, 10, OLD)
    assert launched == 0


@some
@given(
    offers,
    st.integers(1, 3),
    st.lists(st.lists(st.floats(0.9, 1.1), min_size=12, max_size=12), min_size=5, max_size=12),
)
def test_prices_that_waver_take_nobody_back(sold, count, wavers):
    """Within 10 % up and down a pool may find a better layout, and never returns to a former one.

    No two offers swing apart by more than 22 %: a move that needs 30 % lowers the steady price.
    """
    world = settled(*sold, count=count)
    world, _ = lived(world, 20, OLD)
    layouts = [sorted(ours(world))]
    for factors in wavers:
        now = tuple(
            replace(o, usd_per_hour=o.usd_per_hour * f) for o, f in zip(sold, factors, strict=False)
        )
        for _ in range(3):
            world, _ = lived(replace(world, offers=now), 1, OLD)
            if len(ours(world)) == count and sorted(ours(world)) != layouts[-1]:
                layouts.append(sorted(ours(world)))
    assert all(layouts.count(one) == 1 for one in layouts)


def test_a_waver_smaller_than_the_gain_moves_nothing():
    world = settled(offer("a/r/1", 0.1), offer("a/r/2", 0.1))
    for cheap in (0.085, 0.115) * 10:
        sold = (offer("a/r/1", 0.2 - cheap), offer("a/r/2", cheap))
        world, launched = lived(replace(world, offers=sold), 2, OLD)
        assert launched == 0


@some
@given(st.lists(st.booleans(), min_size=4, max_size=20))
def test_no_replica_moves_twice_within_its_stay(flips):
    """Whatever prices do, a replica that has just moved stays for `STAY_S`."""
    a, b = offer("a/r/1", 0.1), offer("a/r/2", 0.1)
    world = settled(a, b)
    moves = []
    for flip in flips:
        dear, cheap = (a, b) if flip else (b, a)
        sold = (replace(dear, usd_per_hour=1.0), replace(cheap, usd_per_hour=0.1))
        for _ in range(4):
            world = replace(world, offers=sold)
            planned = world.plan()
            moves += [world.now] * len(planned.launches)
            world = elapsed(applied(world, planned), 100.0)
    assert all(later - before >= migration.STAY_S for before, later in itertools.pairwise(moves))
