"""What the planner does in the situations that people ask about."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fogft.model import intent as intents
from fogft.model.intent import Intent
from fogft.model.reason import Cause, Reason
from fogft.model.replica import LinkState, Offer
from fogft.planning.observed.backoff import NO_ROOM_S
from fogft.planning.observed.history import Event, EventKind
from tests.planning.pool_worlds import NOW, OFFERS, PLACES, World, applied, replica, shorts, spec

A, B, C, D = PLACES


def launches(world: World) -> list[str]:
    return [f"{launch.slot}.{launch.generation}" for launch in world.plan().launches]


def ends(world: World) -> list[str]:
    return shorts(end.id for end in world.plan().terminations)


def test_new_pool_is_spread_over_clouds() -> None:
    """Two replicas of a new pool lie in two clouds, the cheapest first."""
    planned = World(spec(2)).plan()
    assert [launch.slot for launch in planned.launches] == [0, 1]
    assert [launch.offer.placement for launch in planned.launches] == [A, D]


def test_lost_replica_is_replaced_in_its_slot_and_elsewhere() -> None:
    """A replica that vanished follows as the next generation of its slot, in another place."""
    gone = [
        Event(NOW - 500, EventKind.LAUNCH, 1, 1, D.location),
        Event(NOW - 400, EventKind.READY, 1, 1),
        Event(NOW - 1, EventKind.GONE, 1, 1),
    ]
    world = World(spec(2), events=tuple(gone)).having(replica(0, at=A))
    [launch] = world.plan().launches
    assert (launch.slot, launch.generation) == (1, 2)
    assert launch.offer.placement not in (A, D)


def test_notice_is_replaced_at_once_elsewhere_and_kept_until_then() -> None:
    """A preempted replica serves on while its replacement starts in another location."""
    world = World(spec(2)).having(replica(0, at=A), replica(1, at=D, state="noticed"))
    [launch] = world.plan().launches
    assert (launch.slot, launch.generation) == (1, 2)
    assert launch.offer.placement.location != D.location
    assert ends(world) == []


def test_the_price_of_today_counts_against_the_budget() -> None:
    """The machine at A was ordered for 0.1 and costs 0.3 now: no room; or the other way round."""
    dearer = (replace(OFFERS[0], usd_per_hour=0.3), *OFFERS[1:])
    world = World(spec(2, max_usd_per_hour=0.35)).having(replica(0, at=A))
    assert launches(world) == ["1.1"]
    planned = replace(world, offers=dearer).plan()
    assert planned.launches == ()
    [left] = planned.notes[0].because
    assert (left.cause, left.limit_usd_per_hour) == (Cause.OVER_BUDGET, pytest.approx(0.05))
    fallen = World(spec(2, max_usd_per_hour=0.35)).having(
        replica(0, state="starting", at=A, age_s=10.0, price=0.3)
    )
    assert launches(fallen) == ["1.1"]
    again = applied(fallen, fallen.plan()).plan()
    assert (again.launches, again.terminations, again.draining) == ((), (), ())


def test_as_many_may_be_launched_an_hour_as_go_with_what_is_wanted_now() -> None:
    """Twelve for each replica: of those that `scale` asks for, not of the file's."""
    scaled = World(spec(1), intent=Intent(target=20, scaled_from=1))
    assert len(scaled.plan().launches) == 20
    events = tuple(Event(NOW - 1800 + n, EventKind.LAUNCH, n, 1, A.location) for n in range(20))
    down = World(spec(20), intent=Intent(target=1, scaled_from=20), events=events)
    assert len(down.plan().launches) == 1


def test_a_rebalance_is_an_early_hint() -> None:
    """Its replica serves on, is replaced elsewhere, new before old, and one at a time."""
    world = World(spec(2)).having(
        replica(0, at=A, age_s=1000, at_risk=True), replica(1, at=D, age_s=1000, at_risk=True)
    )
    [launch] = world.plan().launches
    assert (launch.slot, launch.generation) == (0, 2)
    assert launch.offer.placement.location != A.location
    assert (ends(world), world.plan().draining) == ([], ())
    coming = world.having(replica(0, 2, at=B, state="provisioning"))
    assert (launches(coming), ends(coming)) == ([], [])


def test_a_rebalance_right_after_a_move_costs_no_second_launch() -> None:
    """Clouds may recommend to move what has just been moved."""
    world = World(spec(2)).having(replica(0, at=A, age_s=100, at_risk=True), replica(1, at=D))
    assert launches(world) == []


def test_a_rebalance_waits_where_no_surge_is_allowed() -> None:
    """A hint takes no replica away: with no room for another one it serves on."""
    world = World(spec(1, max_surge=0)).having(replica(0, at=A, age_s=1000, at_risk=True))
    assert (launches(world), ends(world)) == ([], [])


@pytest.mark.parametrize("cause", [Cause.DISAGREES, Cause.IGNORES])
def test_a_replica_that_disagrees_with_the_others_is_replaced_new_before_old(cause: Cause) -> None:
    """Voting, or others' answers, mask it meanwhile; it is ended once its replacement serves."""
    bad = replica(2, disagrees=True, ignores=cause is Cause.IGNORES)
    world = World(spec(3)).having(replica(0), replica(1), bad)
    assert (launches(world), ends(world)) == (["2.2"], [])
    [why] = world.plan().launches[0].reason.because
    assert why.cause is cause
    ready = world.having(replica(2, 2, age_s=50))
    assert launches(ready) == []
    assert [id.short for id in ready.plan().draining] == ["2.1"]


def test_notice_does_not_count_against_the_surge() -> None:
    """With no surge allowed, a noticed replica is replaced all the same."""
    world = World(spec(2, max_surge=0)).having(replica(0), replica(1, state="noticed"))
    assert launches(world) == ["1.2"]


def test_only_location_left_is_used_after_a_loss() -> None:
    """To avoid a location is a wish; to have no replica is worse."""
    world = World(spec(2), offers=OFFERS[:1]).having(
        replica(0, at=A), replica(1, at=A, state="noticed")
    )
    assert launches(world) == ["1.2"]


@pytest.mark.parametrize("setting_up", [False, True])
def test_silent_replica_is_replaced_while_another_answers(setting_up: bool) -> None:
    """Silence past `replace_after_s` is replaced, new before old.

    So is one of a cloud that has not told since that its set-up is over; that alone is no reason.
    """
    parts = [replica(0), replica(1, state="silent", silent_s=16, age_s=5000)]
    parts = [replace(p, machine=replace(p.machine, setting_up=setting_up)) for p in parts]
    world = World(spec(2)).having(*parts)
    assert launches(world) == ["1.2"]
    assert ends(world) == []
    unknown = replace(world, links=None)
    assert (launches(unknown), ends(unknown)) == ([], [])


def test_briefly_silent_replica_is_left_alone() -> None:
    """Suspicion alone replaces nothing."""
    world = World(spec(2)).having(replica(0), replica(1, state="silent", silent_s=14))
    assert launches(world) == []


def test_silent_replica_ends_once_replaced() -> None:
    """When enough others serve, the silent one is ended at once."""
    world = World(spec(2)).having(
        replica(0), replica(1, state="silent", silent_s=40), replica(1, 2)
    )
    assert ends(world) == ["1.1"]


@pytest.mark.parametrize(("silent_s", "expected"), [(16, []), (59, []), (61, ["0.2"])])
def test_lone_replica_is_replaced_only_after_long_silence(
    silent_s: float, expected: list[str]
) -> None:
    """One replica's silence is taken for the uplink's until four times `replace_after_s`."""
    world = World(spec(1)).having(replica(0, state="silent", silent_s=silent_s))
    assert launches(world) == expected
    assert ends(world) == []


def test_slow_start_is_waited_for_and_then_given_up() -> None:
    """Not ready within `start_limit_s` is a failed launch; before that it is patience."""
    young = World(spec(2)).having(replica(0), replica(1, state="starting", age_s=299))
    late = World(spec(2)).having(replica(0), replica(1, state="starting", age_s=301))
    assert (launches(young), ends(young)) == ([], [])
    assert (launches(late), ends(late)) == (["1.2"], ["1.1"])


def test_unready_service_is_never_taken_for_a_failed_launch() -> None:
    """A replica that served once and restarts its service is not replaced for it."""
    world = World(spec(2)).having(replica(0), replica(1, state="unready", age_s=900, unready_s=200))
    assert (launches(world), ends(world)) == ([], [])


def test_silence_counts_more_than_what_was_said_before_it() -> None:
    """Two that disagreed and fell silent are lost, and do not block each other's replacement."""
    mute = [replica(n, state="silent", silent_s=60, disagrees=True) for n in (0, 1)]
    world = World(spec(3)).having(*mute, replica(2))
    assert launches(world) == ["0.2", "1.2"]


def test_service_that_stays_away_is_replaced_new_before_old() -> None:
    """A service away past `start_limit_s`, while another replica serves, is replaced."""
    world = World(spec(2)).having(replica(0), replica(1, state="unready", age_s=900, unready_s=301))
    assert (launches(world), ends(world)) == (["1.2"], [])


def test_service_that_is_away_everywhere_is_not_moved_around() -> None:
    """When no replica serves it is the service's fault, and new machines do not help."""
    parts = [replica(slot, state="unready", age_s=900, unready_s=500) for slot in range(2)]
    world = World(spec(2)).having(*parts)
    assert (launches(world), ends(world)) == ([], [])


def test_failed_launch_is_ended_and_followed_at_once() -> None:
    """A failed machine is cleared away and does not count."""
    world = World(spec(2, max_surge=0)).having(replica(0), replica(1, state="failed"))
    assert (launches(world), ends(world)) == (["1.2"], ["1.1"])


def test_drain_replaces_new_before_old() -> None:
    """A drained slot gets its replacement elsewhere first; then the old one drains, then ends."""
    intent = intents.drain(Intent(), 1, 1)
    world = World(spec(2), intent=intent).having(replica(0, at=A), replica(1, at=D))
    [launch] = world.plan().launches
    assert (launch.slot, launch.generation) == (1, 2)
    assert launch.offer.placement.location != D.location
    starting = world.having(replica(1, 2, state="starting"))
    assert (ends(starting), starting.plan().draining) == ([], ())
    ready = world.having(replica(1, 2))
    assert shorts(ready.plan().draining) == ["1.1"]
    assert ends(ready) == []


@pytest.mark.parametrize(
    ("drained_s", "in_flight", "expected"),
    [(0.5, 0, []), (3.0, 1, []), (3.0, 0, ["1.1"]), (11.0, 1, ["1.1"])],
)
def test_draining_ends_when_idle_or_after_its_limit(
    drained_s: float, in_flight: int, expected: list[str]
) -> None:
    """After the mark the proxy gets a moment; then idle ends it, and `DRAIN_LIMIT_S` at last."""
    world = World(spec(1)).having(
        replica(0, at=A), replica(1, drained_s=drained_s, in_flight=in_flight)
    )
    assert ends(world) == expected


def test_excluded_location_is_left_one_replica_at_a_time() -> None:
    """Two replicas in an excluded cloud: one replacement, in another cloud, then the next."""
    intent = intents.exclude(Intent(), "east")
    world = World(spec(2), intent=intent).having(replica(0, at=A), replica(1, at=B))
    [launch] = world.plan().launches
    assert launch.offer.placement == D
    assert launches(world.having(replica(0, 2, at=D, state="starting"))) == []


def test_changed_file_replaces_one_at_a_time() -> None:
    """Outdated replicas follow one another, the wanted number always serving."""
    world = World(spec(3)).having(*(replica(slot, outdated=True) for slot in range(3)))
    assert launches(world) == ["0.2"]
    assert launches(world.having(replica(0, 2, state="starting"))) == []
    done = world.having(replica(0, 2))
    assert (launches(done), shorts(done.plan().draining)) == ([], ["0.1"])


def test_outdated_replica_that_never_served_is_ended_at_once() -> None:
    """A launch of the old file that is still under way is not waited for."""
    world = World(spec(2)).having(replica(0), replica(1, state="provisioning", outdated=True))
    assert (launches(world), ends(world)) == (["1.2"], ["1.1"])


def test_no_surge_replaces_old_before_new_and_says_so() -> None:
    """With `max_surge` 0 an outdated one is drained first, while all others serve."""
    world = World(spec(2, max_surge=0)).having(replica(0), replica(1, outdated=True))
    assert (launches(world), ends(world)) == ([], [])
    assert shorts(world.plan().draining) == ["1.1"]
    assert Reason(Cause.OLD_BEFORE_NEW, slot=1) in world.plan().notes
    drained = replica(1, outdated=True, drained_s=20.0)
    world = World(spec(2, max_surge=0)).having(replica(0), drained)
    assert ends(world) == ["1.1"]


def test_no_room_and_nobody_else_to_answer_keeps_the_old_one() -> None:
    """One replica alone is not ended before its successor: it serves the old file."""
    for lone in (spec(1, max_surge=0), spec(1, max_usd_per_hour=0.15)):
        world = World(lone).having(replica(0, outdated=True))
        assert (launches(world), ends(world), world.plan().draining) == ([], [], ())
        assert Reason(Cause.NO_ROOM_TO_UPDATE, slot=0) in world.plan().notes


def test_a_newcomer_has_to_serve_a_while_before_the_next_is_replaced() -> None:
    """An update goes on only when the new version has shown for some seconds that it serves."""
    fresh = World(spec(2)).having(replica(0, 2, age_s=3), replica(1, outdated=True))
    assert (launches(fresh), ends(fresh), fresh.plan().draining) == ([], [], ())
    settled = World(spec(2)).having(replica(0, 2, age_s=30), replica(1, outdated=True))
    assert launches(settled) == ["1.2"]


def test_an_outdated_one_that_never_served_is_ended_at_once() -> None:
    """The failed new one of a rollback answers probes and nothing else: it is no loss."""
    world = World(spec(2)).having(replica(0), replica(1), replica(2, state="unready"))
    never = replace(
        replica(2, outdated=True, state="unready"),
        events=replica(2, state="starting").events,
    )
    world = World(spec(2)).having(replica(0), replica(1), never)
    assert ends(world) == ["2.1"]


def test_budget_holds_and_is_explained() -> None:
    """A launch beyond `max_usd_per_hour` waits, with the numbers in the note."""
    world = World(spec(3, max_usd_per_hour=0.26)).having(replica(0), replica(1, price=0.11))
    assert launches(world) == []
    [note] = world.plan().notes
    [dear] = note.because
    assert (note.cause, dear.cause) == (Cause.WAITS, Cause.OVER_BUDGET)
    assert (dear.usd_per_hour, dear.limit_usd_per_hour) == pytest.approx((0.1, 0.05))


def test_budget_lets_a_silent_machine_make_room() -> None:
    """Under a cap, the silent machine that blocks its own replacement goes first."""
    world = World(spec(2, max_usd_per_hour=0.21)).having(
        replica(0), replica(1, state="silent", silent_s=30)
    )
    assert (launches(world), ends(world)) == ([], ["1.1"])


def test_scale_up_fills_free_slots() -> None:
    """More replicas take the lowest free slots, all at once."""
    intent = intents.scale(Intent(), spec(2), 2, NOW)
    world = World(spec(2), intent=intent).having(replica(0), replica(2))
    assert launches(world) == ["1.1", "3.1"]


def test_scale_down_ends_who_does_not_serve_first() -> None:
    """Not ready goes before ready, and without draining."""
    world = World(spec(2)).having(replica(0), replica(1), replica(2, state="starting"))
    assert (ends(world), world.plan().draining) == (["2.1"], ())


def test_scale_down_thins_the_most_crowded_place() -> None:
    """Of three that serve, one of the two in the same region goes, the higher slot."""
    world = World(spec(2)).having(replica(0, at=A), replica(1, at=B), replica(2, at=D))
    assert shorts(world.plan().draining) == ["1.1"]


def test_scale_down_keeps_who_drains_already() -> None:
    """The choice sticks: the one that was marked is the one that ends."""
    world = World(spec(2)).having(
        replica(0, at=A, drained_s=5.0), replica(1, at=B), replica(2, at=D)
    )
    assert ends(world) == ["0.1"]


def test_all_silent_is_the_uplink_and_is_said() -> None:
    """Nothing is replaced when all are silent, and status can say why."""
    parts = [replica(slot, state="silent", silent_s=500) for slot in range(3)]
    planned = World(spec(3)).having(*parts).plan()
    assert (planned.launches, planned.terminations) == ((), ())
    assert planned.notes[0] == Reason(Cause.UPLINK_SUSPECTED)
    surplus = World(spec(1)).having(*parts[:2], replica(2, state="starting"))
    assert (ends(surplus), ends(replace(surplus, links=None))) == ([], [])


def test_vanished_machine_is_replaced_even_behind_a_dead_uplink() -> None:
    """Absent from the cloud's list is gone, whatever the links say."""
    parts = [replica(slot, state="silent", silent_s=500) for slot in range(2)]
    assert launches(World(spec(3)).having(*parts)) == ["2.1"]


def test_no_report_doubts_nobody_but_still_fills_gaps() -> None:
    """Without the client proxy's report nothing is ended, and what is missing is launched."""
    world = replace(World(spec(2)).having(replica(0), replica(1), replica(2)), links=None)
    assert (launches(world), ends(world)) == ([], [])
    assert world.plan().notes == (Reason(Cause.NOBODY_HEARD),)
    assert launches(replace(world, spec=spec(4))) == ["3.1"]


def test_resting_location_is_skipped_and_reported() -> None:
    """After a refusal a location rests; when all rest, the note lists the causes."""
    refused = [
        event
        for slot, place in enumerate(PLACES)
        for event in (
            Event(NOW - 2, EventKind.LAUNCH, slot, 1, place.location),
            Event(NOW - 1, EventKind.REFUSED, slot, 1, "", Reason(Cause.CAPACITY)),
        )
    ]
    world = World(spec(1), events=tuple(refused))
    assert launches(world) == []
    [all_rest] = world.plan().notes[0].because
    assert Reason(Cause.CAPACITY, location="east/one/a") in all_rest.because
    assert launches(replace(world, now=NOW + NO_ROOM_S)) == ["0.2"]


def test_mark_of_our_own_is_not_the_replicas_wish() -> None:
    """The proxy's echo of our draining mark launches no replacement, and hides no notice."""
    part = replica(1, drained_s=1.0)
    assert part.link is not None
    echo = replace(part, link=replace(part.link, draining=True))
    world = World(spec(1)).having(replica(0), echo)
    assert launches(world) == []
    wish = replace(part.link, leaving=True, draining=True)
    assert launches(World(spec(2)).having(replica(0), replace(echo, link=wish))) == ["1.2"]
    unmarked = replace(echo, events=echo.events[:2], link=wish)
    assert launches(World(spec(2)).having(replica(0), unmarked)) == ["1.2"]


def test_a_notice_stays_the_reason_while_the_replica_is_drained() -> None:
    """Its successor is on the way and our mark is set: it still leaves for its notice."""
    part = replica(1, drained_s=60.0)
    assert part.link is not None
    going = replace(part, link=replace(part.link, leaving=True, draining=True))
    world = World(spec(2)).having(replica(0), going, replica(1, generation=2))
    [ending] = world.plan().terminations
    assert ending.id.short == "1.1"
    assert ending.reason == Reason(Cause.NOTICE_BY_REPLICA)


def test_restarted_proxy_does_not_make_young_ones_of_old_ones() -> None:
    """While links connect anew, a replica that served before is not ended as a late starter."""
    part = replica(1, age_s=9000)
    assert part.link is not None
    link = replace(part.link, state=LinkState.CONNECTING, ready=frozenset())
    world = World(spec(2)).having(replica(0), replace(part, link=link))
    assert (launches(world), ends(world)) == ([], [])


def test_stopping_ends_all_and_launches_nothing() -> None:
    """`down` needs no drains."""
    world = World(spec(2), intent=Intent(stopping=True)).having(
        replica(0), replica(1, state="provisioning")
    )
    assert (launches(world), ends(world)) == ([], ["0.1", "1.1"])


def test_price_decides_among_equal_places() -> None:
    """Within one failure domain the cheaper instance wins."""
    dear, cheap = Offer(A, 0.5), Offer(replace(A, instance="m2"), 0.2)
    [launch] = World(spec(1), offers=(dear, cheap)).plan().launches
    assert launch.offer == cheap
