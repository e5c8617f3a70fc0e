"""Which on-demand machines are stopped rather than ended, started rather than bought, and ended."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fogft.model.choices import OnDemandSpec
from fogft.model.groups import STAND_INS
from fogft.model.intent import Intent
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Machine, Observed, Offer, Placement
from fogft.planning.buying import PlannedLaunch
from fogft.planning.observed.history import History
from fogft.planning.planner import PlannedEnd
from fogft.planning.sizing import Inputs
from fogft.planning.standbys import started, stopped, superfluous
from tests.planning.pool_worlds import NOW, ON_DEMAND, PLACES, UID, replica, spec

ENOUGH, NEEDED = Reason(Cause.ENOUGH_SPOT), Reason(Cause.STANDS_IN)


def pool(standbys: int = 1):
    return spec(2, on_demand=OnDemandSpec(0, fallback=True, standbys=standbys))


def on_demand(place: Placement = PLACES[0]) -> Placement:
    return replace(place, spot=False)


def machine(number: int = 0, *, at: Placement | None = None, outdated: bool = False) -> Machine:
    slot, at = STAND_INS + number, at or on_demand()
    return replica(slot, at=at, outdated=outdated, of=pool()).machine


def observed(*, runs: tuple[Machine, ...] = (), stands_by: tuple[Machine, ...] = (), **others):
    return Observed(NOW, runs, (), ON_DEMAND, standbys=stands_by, **others)


def bought(number: int = 1, generation: int = 7) -> PlannedLaunch:
    return PlannedLaunch(STAND_INS + number, generation, ON_DEMAND[1], NEEDED)


def begun(launches, seen: Observed, given: Intent | None = None, slack_usd: float | None = None):
    return started(Inputs(pool(2), given or Intent(), seen, History()), launches, slack_usd)


# -- started ----------------------------------------------------------------------------------


def test_what_stands_by_is_started_in_place_of_a_machine_that_would_be_bought():
    """Under its own id, at today's price of where it is."""
    found = begun([bought()], observed(stands_by=(machine(),)))
    assert found == {STAND_INS + 1: PlannedLaunch(STAND_INS, 1, ON_DEMAND[0], NEEDED)}


def test_each_is_started_once_and_the_rest_is_bought():
    launches = [bought(1), bought(2), bought(3)]
    found = begun(launches, observed(stands_by=(machine(0), machine(5))))
    assert {slot: start.slot for slot, start in found.items()} == {
        STAND_INS + 1: STAND_INS,
        STAND_INS + 2: STAND_INS + 5,
    }


@pytest.mark.parametrize(
    "why",
    [
        *("another version", "is being ended", "its place is not offered"),
        *("its place is excluded", "a spot machine is wanted"),
    ],
)
def test_what_would_not_be_the_same_is_bought(why):
    standby = machine(
        outdated=why == "another version",
        at=on_demand(replace(PLACES[0], zone="z")) if why == "its place is not offered" else None,
    )
    ending = frozenset({standby.id} if why == "is being ended" else ())
    launch = bought()._replace(slot=0) if why == "a spot machine is wanted" else bought()
    given = Intent(excluded=frozenset({"east"} if why == "its place is excluded" else ()))
    assert begun([launch], observed(stands_by=(standby,), ending=ending), given) == {}


def test_one_of_a_type_that_came_instead_is_started_too_within_the_cap():
    """Its place may be dearer than what was planned, by so much at most."""
    standby = machine(at=replace(on_demand(), instance="m6i.metal"))
    seen = observed(stands_by=(standby,))
    cheap = bought()._replace(offer=replace(ON_DEMAND[1], usd_per_hour=0.2))
    [start] = begun([cheap], seen, slack_usd=0.11).values()
    assert start.offer.placement == standby.placement
    assert begun([cheap], seen, slack_usd=0.09) == {}


# -- stopped ----------------------------------------------------------------------------------


def test_one_that_made_way_for_spot_is_stopped_while_there_is_room_for_it():
    one, two = machine(0), machine(1)
    ends = [PlannedEnd(one.id, ENOUGH), PlannedEnd(two.id, ENOUGH)]
    found = stopped(pool(1), ends, observed(runs=(one, two)))
    assert found == {
        one.id: PlannedLaunch(one.id.slot, 1, Offer(one.placement, one.usd_per_hour), ENOUGH)
    }
    assert list(stopped(pool(2), ends, observed(runs=(one, two)))) == [one.id, two.id]
    assert stopped(pool(1), ends, observed(runs=(one, two), stands_by=(machine(2),))) == {}
    assert stopped(pool(0), ends, observed(runs=(one, two))) == {}


@pytest.mark.parametrize(
    ("reason", "made"),
    [
        (Reason(Cause.NOT_WANTED), {}),
        (Reason(Cause.REPLACED), {}),
        (ENOUGH, {"outdated": True}),
        (ENOUGH, {"at": PLACES[0]}),  # a spot machine: its cloud may keep what it was
    ],
)
def test_what_ends_for_another_reason_or_would_be_of_no_use_is_ended(reason, made):
    one = machine(**made)
    assert stopped(pool(), [PlannedEnd(one.id, reason)], observed(runs=(one,))) == {}


def test_what_the_cloud_does_not_list_any_more_is_not_stopped():
    assert stopped(pool(), [PlannedEnd(machine().id, ENOUGH)], observed()) == {}
    unknown = replace(observed(), machines=None)
    assert stopped(pool(), [PlannedEnd(machine().id, ENOUGH)], unknown) == {}


# -- ended ------------------------------------------------------------------------------------


def test_of_more_standbys_than_the_file_asks_for_the_last_end():
    three = tuple(machine(number) for number in range(3))
    for kept in range(4):
        found = superfluous(pool(kept), observed(stands_by=three), ())
        assert found == [(one.id, Reason(Cause.NOT_WANTED)) for one in three[kept:]]


def test_one_of_another_version_ends_however_few_there_are():
    old = machine(outdated=True)
    assert superfluous(pool(3), observed(stands_by=(old,)), ()) == [
        (old.id, Reason(Cause.OUTDATED))
    ]


def test_one_that_is_started_or_ends_already_is_none_that_stands_by():
    one, two = machine(0), machine(1)
    start = PlannedLaunch(one.id.slot, one.id.generation, ON_DEMAND[0], NEEDED)
    assert superfluous(pool(1), observed(stands_by=(one, two)), [start]) == []
    ending = observed(stands_by=(one, two), ending=frozenset({one.id}))
    assert superfluous(pool(1), ending, ()) == []
    assert one.id.pool_uid == UID
