"""When an `up` is over, and how it ended."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fogft.model.reason import Cause, Reason
from fogft.planning.rollout import UpdateState
from fogft.pool.commands.outcome import AGAIN_S, HOPELESS_RESTARTS, Awaited, Outcome, Settled
from fogft.pool.commands.status import Seen
from fogft.pool.manager.status import PoolStatus, UpdateStatus
from tests.fakes.pools import REPLICA, STATUS

APPLIED_AT = 10.0
UP = replace(STATUS, notes=(), replicas=(REPLICA,), target=1, observed_at=APPLIED_AT + AGAIN_S)
LEAVING = replace(REPLICA, slot=1, phase="draining")
SILENT = (replace(UP.services[0], ready_replicas=0),)
STARTING = replace(REPLICA, phase="starting")
HOPELESS = replace(STARTING, restarts=HOPELESS_RESTARTS)
LEAVING = replace(HOPELESS, phase="draining", differs=True)
UPDATE = Awaited(frozenset({"/plan"}), APPLIED_AT, digest="new")


def outcome(status: PoolStatus, awaited: Awaited | None = None, *, is_last: bool = False):
    awaited = awaited or Awaited(frozenset({"/plan"}), APPLIED_AT)
    return awaited.outcome(Seen(status, 0.1, True), is_last=is_last)


def updated(state: UpdateState | None, *, applied: str = "new", fault: str = "", **others: object):
    update = UpdateStatus(state.value, 1, 2, fault) if state else None
    return replace(UP, applied=applied, update=update, **others)


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        (UP, Outcome.ANSWERING),
        (replace(UP, observed_at=9.0), Outcome.PENDING),  # seen before the file was applied
        (replace(UP, proxy_alive=False), Outcome.PENDING),
        (replace(UP, services=()), Outcome.PENDING),  # the manager has not read the new file
        (replace(UP, services=SILENT), Outcome.PENDING),
        (
            replace(UP, services=(*UP.services, replace(UP.services[0], name="/old"))),
            Outcome.PENDING,
        ),
        (replace(UP, services=SILENT, replicas=(HOPELESS,)), Outcome.RUN_KEEPS_ENDING),
        # Before, which says nothing of a command that was mended since.
        (replace(UP, services=SILENT, replicas=(HOPELESS,), observed_at=25.0), Outcome.PENDING),
        (replace(UP, services=SILENT, replicas=(HOPELESS, STARTING)), Outcome.PENDING),
        (replace(UP, services=SILENT, replicas=(LEAVING,)), Outcome.PENDING),
        (replace(UP, replicas=(LEAVING, HOPELESS)), Outcome.ANSWERING),  # one that leaves answers
        (replace(UP, services=SILENT, replicas=(LEAVING, HOPELESS)), Outcome.RUN_KEEPS_ENDING),
        (
            replace(UP, services=SILENT, replicas=(replace(STARTING, differs=True),)),
            Outcome.TYPES_DIFFER,
        ),
    ],
)
def test_a_pool_answers_once_every_service_does(status, expected):
    assert outcome(status) is expected


def test_a_pool_that_gave_up_is_not_waited_for():
    """Nothing that was launched is left, and nothing more is launched."""
    status = replace(UP, services=SILENT, replicas=(), reasons=(Reason(Cause.NEVER_READY),))
    assert outcome(status) is Outcome.NEVER_READY
    assert outcome(replace(status, replicas=(STARTING,))) is Outcome.PENDING
    assert outcome(replace(status, observed_at=9.0)) is Outcome.PENDING


def test_a_schedule_that_asks_for_no_replica_is_no_failure():
    """`up` of a pool that sleeps at night does not wait for the morning."""
    asleep = replace(UP, target=0, ready=0, replicas=())
    assert outcome(asleep) is Outcome.ANSWERING
    assert outcome(replace(asleep, observed_at=5.0)) is Outcome.PENDING
    assert outcome(replace(asleep, cloud_reachable=False, services=SILENT)) is Outcome.PENDING


def test_services_that_are_discovered_are_answered_once_there_are_some():
    found = Awaited(frozenset(), APPLIED_AT)
    assert outcome(UP, found) is Outcome.ANSWERING
    assert outcome(replace(UP, services=()), found) is Outcome.PENDING


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        (updated(None, applied="old"), Outcome.PENDING),
        (updated(UpdateState.IN_PROGRESS), Outcome.PENDING),
        (updated(UpdateState.STOPPED, fault="why"), Outcome.PENDING),
        (updated(UpdateState.ROLLED_BACK, fault="why"), Outcome.WITHDRAWN),
        (updated(UpdateState.ROLLED_BACK, fault="why", observed_at=9.0), Outcome.PENDING),
        (updated(None), Outcome.ANSWERING),
        (updated(None, applied="old", replicas=(HOPELESS,)), Outcome.PENDING),
        (updated(UpdateState.IN_PROGRESS, replicas=(HOPELESS,)), Outcome.RUN_KEEPS_ENDING),
    ],
)
def test_an_update_is_over_when_it_is_done_or_rolled_back(status, expected):
    """The pool answers all the time: that does not say that the update has come to its end."""
    assert outcome(status, UPDATE) is expected


def test_when_no_time_is_left_a_pool_that_answers_is_good_enough():
    """But an update that was stopped has failed, though its end was not seen."""
    assert outcome(updated(UpdateState.IN_PROGRESS), UPDATE, is_last=True) is Outcome.ANSWERING
    stopped = updated(UpdateState.STOPPED, fault="why")
    assert outcome(stopped, UPDATE, is_last=True) is Outcome.WITHDRAWN
    assert outcome(replace(UP, services=SILENT), is_last=True) is Outcome.PENDING


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        (UP, Outcome.ANSWERING),
        (replace(UP, observed_at=9.0), Outcome.PENDING),  # seen before the change
        (replace(UP, target=2), Outcome.PENDING),  # one more is to come
        (replace(UP, replicas=(REPLICA, LEAVING)), Outcome.PENDING),
        (replace(UP, replicas=(replace(REPLICA, generation=2),)), Outcome.ANSWERING),
    ],
)  # fmt: skip
def test_a_change_is_done_once_the_pool_is_whole_and_nothing_leaves(status, expected):
    assert Settled(APPLIED_AT).outcome(Seen(status, 0.1, True)) is expected


def test_a_drain_is_done_once_the_replica_is_gone():
    """The pool is whole all the time: the new one is there before the old one goes."""
    drained = Settled(APPLIED_AT, gone=(0, 1))
    both = replace(UP, replicas=(REPLICA, replace(REPLICA, generation=2)))
    new = replace(UP, replicas=(replace(REPLICA, generation=2),))
    assert drained.outcome(Seen(UP, 0.1, True)) is Outcome.PENDING
    assert drained.outcome(Seen(both, 0.1, True)) is Outcome.PENDING
    assert drained.outcome(Seen(new, 0.1, True)) is Outcome.ANSWERING
    booting = Settled(APPLIED_AT, gone=(0, 2))  # the one that was to replace it
    assert booting.outcome(Seen(UP, 0.1, True)) is Outcome.PENDING
