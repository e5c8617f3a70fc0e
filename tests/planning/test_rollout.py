"""What speaks against a new version, what does not, and when one is good."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fogft.model.reason import Cause, Reason
from fogft.model.replica import MachinePhase
from fogft.planning.observed.health import judge
from fogft.planning.observed.history import Event, EventKind
from fogft.planning.rollout import (
    CRASH_LOOP,
    Trial,
    UpdateState,
    at_least,
    describe,
    fault,
    has_room,
    is_whole,
)
from tests.planning.pool_worlds import NOW, UID, Part, World, replica, spec

GOOD = spec(2, task={"run": "good"})
NEW = spec(2, task={"run": "new"})


def found(world: World, began_at: float = NOW - 200) -> str:
    health = judge(UID, NEW, world.observed, world.history)
    return fault(NEW, GOOD, health, world.history, began_at)


def counted(part: Part, **counts: int) -> Part:
    assert part.link is not None
    return replace(part, link=replace(part.link, **counts))


def pool(*parts: Part) -> World:
    return World(NEW).having(*parts)


OLD = replica(0, of=GOOD)


def test_nothing_speaks_against_a_version_that_starts_or_serves() -> None:
    for state in ("provisioning", "starting", "unready", "ready"):
        assert found(pool(OLD, replica(1, 2, state=state, of=NEW, age_s=20))) is None


def test_a_run_that_keeps_ending_is_no_good() -> None:
    starting = replica(1, 2, state="unready", of=NEW, age_s=20)
    assert found(pool(OLD, counted(starting, restarts=CRASH_LOOP - 1))) is None
    fault = found(pool(OLD, counted(starting, restarts=CRASH_LOOP)))
    assert (fault.cause, fault.replica) == (Cause.REPLICA_FAILS, "1.2")
    assert [(why.cause, why.count) for why in fault.because] == [(Cause.RUN_ENDS, 4)]


def test_a_service_that_came_up_after_some_attempts_is_left_alone() -> None:
    serving = replica(1, 2, of=NEW, age_s=20)
    assert found(pool(OLD, counted(serving, restarts=9))) is None


def test_what_is_wrong_with_the_old_version_does_not_speak_against_the_new_one() -> None:
    crashing = counted(replica(0, state="unready", of=GOOD), restarts=50, failed=900)
    assert found(pool(crashing, replica(1, 2, of=NEW))) is None


@pytest.mark.parametrize(
    ("failure", "is_fault"),
    [
        (Reason(Cause.SETUP), True),
        (Reason(Cause.TIMEOUT, because=(Reason(Cause.NOT_READY),)), True),
        (Reason(Cause.TIMEOUT, because=(Reason(Cause.NOT_RUNNING),)), False),
        (Reason(Cause.CAPACITY), False),
        (Reason(Cause.QUOTA), False),
        (Reason(Cause.ERROR), False),
    ],
)
def test_a_failed_launch_is_the_versions_fault_or_the_clouds(
    failure: Reason, is_fault: bool
) -> None:
    failed = replica(1, 2, state="failed", of=NEW, age_s=20)
    failed = replace(failed, machine=replace(failed.machine, failure=failure))
    assert failed.machine.phase is MachinePhase.FAILED
    assert bool(found(pool(OLD, failed))) is is_fault


def test_launches_that_keep_failing_are_the_versions_fault_in_the_end() -> None:
    """An image that does not exist looks like a broken cloud, until it does so again."""

    why = Reason(Cause.ERROR, words="no such image")

    def refused(times: int, at: float, why: Reason = why) -> tuple[Event, ...]:
        return tuple(
            Event(at + i, kind, 1, i + 2, "east/one/a", why)
            for i in range(times)
            for kind in (EventKind.LAUNCH, EventKind.REFUSED)
        )

    old = replica(0, of=GOOD, age_s=5000)
    assert found(replace(pool(old), events=(*old.events, *refused(2, NOW - 50)))) is None
    fault = found(replace(pool(old), events=(*old.events, *refused(3, NOW - 50))))
    assert (fault.cause, fault.count) == (Cause.LAUNCHES_FAIL, 3)
    before = replace(pool(old), events=(*old.events, *refused(3, NOW - 250)))
    assert found(before) is None, "before the update began"
    taken = refused(3, NOW - 50, Reason(Cause.NOT_LISTED))
    assert found(replace(pool(old), events=(*old.events, *taken))) is None, "the market's doing"


def test_more_errors_than_the_old_version_has_are_a_fault() -> None:
    new = replica(1, 2, of=NEW)
    old = counted(OLD, answered=990, failed=10)
    assert found(pool(old, counted(new, answered=95, failed=4))) is None
    why = found(pool(old, counted(new, answered=50, failed=25)))
    assert why.cause is Cause.MORE_ERRORS
    assert [(one.count, one.of) for one in why.because] == [(25, 75), (10, 1000)]


def test_as_many_errors_as_the_old_version_has_are_none() -> None:
    """Requests that no version can answer speak against neither."""
    old, new = counted(OLD, answered=50, failed=50), replica(1, 2, of=NEW)
    assert found(pool(old, counted(new, answered=48, failed=52))) is None


@example(hits=0, others=15)
@given(hits=st.integers(0, 400), others=st.integers(0, 400))
def test_the_lower_end_of_a_share_is_below_it(hits: int, others: int) -> None:
    """It claims no more than was seen, and lies in the range of a share."""
    of = hits + others
    assert 0 <= at_least(hits, of) <= (hits / of if of else 0) + 1e-12


@given(st.integers(1, 200), st.integers(1, 200))
def test_more_evidence_makes_surer(hits: int, others: int) -> None:
    """The same share of ten times as many requests claims more."""
    of = hits + others
    assert at_least(10 * hits, 10 * of) >= at_least(hits, of)


def whole(world: World, settle_s: float = 5.0) -> bool:
    health = judge(UID, NEW, world.observed, world.history)
    return is_whole(NEW, health, wanted=2, now=NOW, settle_s=settle_s)


def test_a_pool_is_whole_when_all_that_is_wanted_serves_and_nothing_else_is_there() -> None:
    both = [replica(0, 2, of=NEW), replica(1, 2, of=NEW)]
    assert whole(pool(*both))
    assert not whole(pool(both[0])), "one is missing"
    assert not whole(pool(*both, replica(2, of=GOOD))), "an old one is still there"
    assert not whole(pool(both[0], replica(1, 2, state="unready", of=NEW)))
    assert not whole(pool(both[0], replica(1, 2, age_s=3, of=NEW))), "one has yet to settle"
    assert not whole(replace(pool(*both), links=None)), "nobody is heard"


def test_what_is_told_of_an_update() -> None:
    def told(trial: Trial, *parts: Part, of=NEW, good=GOOD) -> object:
        world = World(of).having(*parts)
        health = judge(UID, of, world.observed, world.history)
        update = describe(of, good, trial, health, 2)
        return update and (update.state, update.done, update.of)

    new, rejected = replica(1, 2, of=NEW), Trial("f", 1.0, "it broke")
    assert told(Trial(), OLD, new) == (UpdateState.IN_PROGRESS, 1, 2)
    assert told(Trial(), replica(0, 2, of=NEW), new, good=NEW) is None
    assert told(Trial(), OLD, new, good=None) is None
    assert told(rejected, OLD, new, of=GOOD) == (UpdateState.STOPPED, 1, 2)
    back = [OLD, replica(1, 3, of=GOOD)]
    assert told(rejected, *back, of=GOOD) == (UpdateState.ROLLED_BACK, 2, 2)


@pytest.mark.parametrize(
    ("others", "room"),
    [
        ({}, True),
        ({"max_usd_per_hour": 0.35}, True),
        ({"max_usd_per_hour": 0.25}, False),
        ({"max_surge": 0}, False),
    ],
)
def test_room_for_both(others: dict, room: bool) -> None:
    assert has_room(spec(2, **others), 0.2, 0.1) is room


@pytest.mark.parametrize(
    ("resources", "same"),
    [
        ({"infra": "aws/us-west-2", "cpus": "4+"}, True),
        ({"any_of": [{"infra": "aws"}, {"infra": "gcp"}], "cpus": "4+"}, True),
        ({"infra": "aws", "cpus": "8+"}, False),
        ({"infra": "aws", "cpus": "4+", "image_id": "docker:ros"}, False),
    ],
)
def test_a_machine_of_another_kind_is_another_version_and_a_place_is_not(resources, same) -> None:
    """`image_id` or `cpus` replace replicas; a further region does not."""
    first = spec(2, task={"run": "x", "resources": {"infra": "aws", "cpus": "4+"}})
    other = spec(2, task={"run": "x", "resources": resources})
    assert (first.replica_hash == other.replica_hash) is same
