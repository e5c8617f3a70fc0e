"""Long cloud calls: never two at once on a replica, and none is ever overlooked."""

from __future__ import annotations

import logging
import threading
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest

from fogft.errors import CloudUnreachable, NoCapacity, StateError
from fogft.model.reason import Cause, Reason
from fogft.model.replica import LinkReport, LinkState, ReplicaId
from fogft.model.topology import LaunchedGateway
from fogft.planning.observed.clock_jumps import Reading
from fogft.planning.observed.history import Event, EventKind
from fogft.planning.planner import PlannedLaunch
from fogft.pool.folder.store import Identity
from fogft.pool.manager.operations import Operations
from fogft.pool.manager.reconciler import Reconciler
from fogft.process import prepared_thread
from tests.fakes.cloud import MockCloud, zones
from tests.fakes.threads import no_more
from tests.fakes.waiting import wait_for
from tests.planning.pool_worlds import NOW, SERVICE, UID, spec
from tests.simulation.memory_store import MemoryStore

ID = ReplicaId(UID, 0, 1)


def test_one_operation_a_replica() -> None:
    """A second one is refused until the first one's outcome was collected."""
    waiting: list = []
    operations: Operations[str] = Operations(lambda run: partial(waiting.append, run))
    assert operations.start(ID, "first", lambda: None)
    assert not operations.start(ID, "second", lambda: None)
    waiting.pop()()
    assert operations.busy() == {ID: "first"}  # ended, but nobody has looked yet
    assert not operations.start(ID, "second", lambda: None)
    assert [(o.subject, o.error) for o in operations.collect()] == [("first", None)]
    assert operations.start(ID, "second", lambda: None)


def test_operation_without_a_thread_has_failed_and_keeps_no_slot() -> None:
    """Nothing is recorded of it; the next tick may try again."""
    operations: Operations[str] = Operations(prepared_thread)
    with no_more(), pytest.raises(OSError, match="TasksMax"):
        operations.start(ID, "first", lambda: None, lambda: pytest.fail("recorded"))
    assert (operations.busy(), operations.collect()) == ({}, [])


def test_outcome_carries_the_error_and_wakes(caplog: pytest.LogCaptureFixture) -> None:
    """A refusal is data; a defect of an adapter is logged with its trace; both wake the owner."""
    woken = threading.Event()
    operations: Operations[None] = Operations(lambda run: run, woken.set)

    def refuse() -> None:
        raise NoCapacity("full")

    def break_down() -> None:
        raise ZeroDivisionError

    with caplog.at_level(logging.ERROR):
        operations.start(ID, None, refuse)
        assert not caplog.records
        operations.start(ReplicaId(UID, 1, 1), None, break_down)
    assert [type(o.error) for o in operations.collect()] == [NoCapacity, ZeroDivisionError]
    assert caplog.records[0].exc_info
    assert woken.is_set()


class Bench:
    """A reconciler over the mock cloud, its operations run by hand."""

    def __init__(self, replicas: int = 1) -> None:
        self.now = NOW
        self.cloud = MockCloud(lambda: self.now, zones("east/one/a", "west/one/a"))
        self.store = MemoryStore(Identity("pool", UID, "mock", "/p", NOW), spec(replicas))
        self.waiting: list = []
        self.ready, self.disagrees = True, False
        self.reconciler = Reconciler(
            self.cloud,
            self.store,
            clock=lambda: Reading(*[self.now] * 3),
            links=self.links,
            prepare=lambda run: partial(self.waiting.append, run),
        )

    def links(self, uid: str, now: float) -> tuple[LinkReport, ...]:
        members = self.store.published.members if self.store.published else ()
        ready = frozenset({SERVICE.name}) if self.ready else frozenset()
        return tuple(
            LinkReport(m.id, LinkState.UP, ready, disagrees=self.disagrees) for m in members
        )

    def run(self) -> None:
        while self.waiting:
            self.waiting.pop(0)()

    def kinds(self) -> list[EventKind]:
        return [event.kind for event in self.store.events]


def test_launch_is_in_the_history_before_the_cloud_is_asked() -> None:
    """And while the call is under way nothing more is ordered, though the list lacks it."""
    bench = Bench()
    bench.reconciler.tick()
    assert bench.kinds() == [EventKind.LAUNCH]
    assert bench.cloud.calls.launched == []
    for _ in range(3):
        tick = bench.reconciler.tick()
        assert tick.plan.launches == ()
    assert len(bench.waiting) == 1


def test_launch_that_gets_no_thread_is_no_failure_of_its_location() -> None:
    """Status says why nothing starts; the tick after there is room launches the same."""
    bench = Bench()
    bench.reconciler.operations = Operations(prepared_thread)
    with no_more():
        for _ in range(3):
            tick = bench.reconciler.tick()
    assert bench.store.events == []
    assert [n.cause for n in tick.plan.notes if "TasksMax" in n.words] == [Cause.TROUBLE]
    bench.reconciler.tick()
    wait_for(lambda: [id.short for id in bench.cloud.calls.launched] == ["0.1"])
    assert bench.kinds() == [EventKind.LAUNCH]


def test_launch_that_cannot_be_written_is_not_begun() -> None:
    """The thread that was ready for it ends, and the next tick may order the same again."""
    bench = Bench()
    written = bench.store.append

    def full(event: Event) -> None:
        raise StateError("no space left")

    bench.store.append = full  # type: ignore[method-assign]
    tick = bench.reconciler.tick()
    assert tick.plan.notes[-1].words == "no space left"
    bench.run()
    bench.store.append = written  # type: ignore[method-assign]
    bench.reconciler.tick()
    bench.run()
    assert [id.short for id in bench.cloud.calls.launched] == ["0.1"]
    assert bench.kinds() == [EventKind.LAUNCH]


def test_refused_launch_is_followed_elsewhere_under_a_new_generation() -> None:
    """A want of capacity is remembered with its cause, and the next offer is tried."""
    bench = Bench()
    bench.cloud.zones["east/one/a"].capacity = 0
    bench.reconciler.tick()
    bench.run()
    bench.reconciler.tick()
    bench.run()
    assert bench.kinds() == [EventKind.LAUNCH, EventKind.REFUSED, EventKind.LAUNCH]
    refusal = bench.store.events[1].reason
    assert refusal is not None
    assert refusal.cause is Cause.CAPACITY
    assert [id.short for id in bench.cloud.calls.launched] == ["0.2"]


def test_launch_of_unknown_outcome_is_looked_up() -> None:
    """Unreachable is not refused: what the cloud lists counts, what it lacks is followed."""
    bench = Bench()
    bench.cloud.fail_next("launch", CloudUnreachable("?"))
    bench.reconciler.tick()
    bench.run()
    bench.reconciler.tick()
    assert bench.kinds() == [EventKind.LAUNCH, EventKind.GONE, EventKind.LAUNCH]


@pytest.mark.parametrize(
    ("notice_s", "fault", "reason"),
    [
        (1.5, None, Reason(Cause.NOTICE)),
        (0.0, None, Reason(Cause.NOT_LISTED)),
        (0.0, Cause.DISAGREES, Reason(Cause.NOT_LISTED, because=(Reason(Cause.DISAGREES),))),
    ],
)
def test_why_a_machine_went_is_remembered(
    notice_s: float, fault: Cause | None, reason: Reason
) -> None:
    """A preemption notice, if there was one; else that it is not listed, and its last fault."""
    bench = Bench()
    for _ in range(5):
        bench.reconciler.tick()
        bench.run()
        bench.now += 30.0
    bench.disagrees = fault is not None
    bench.reconciler.tick()
    bench.cloud.preempt(bench.cloud.machines(UID)[0].id, notice_s=notice_s)
    for _ in range(3):
        bench.reconciler.tick()
        bench.now += 1.0
    went = [event for event in bench.store.events if event.kind is EventKind.GONE]
    assert [event.reason for event in went] == [reason]


@pytest.mark.parametrize("reason", [Reason(Cause.NOT_WANTED), None])
def test_why_a_machine_was_ended_is_told_when_it_has_ended(reason: Reason | None) -> None:
    """By a later manager, too; histories of earlier versions may have no reason."""
    bench = Bench()
    for _ in range(5):
        bench.reconciler.tick()
        bench.run()
        bench.now += 30.0
    (machine,) = bench.cloud.machines(UID)
    bench.store.events.append(Event(bench.now, EventKind.ENDING, 0, 1, reason=reason))
    bench.store.reopen()
    bench.cloud.preempt(machine.id)
    bench.reconciler.tick()
    ended = [event for event in bench.store.events if event.kind is EventKind.ENDED]
    assert [event.reason for event in ended] == [reason]


def test_readiness_is_remembered_once_for_each_change() -> None:
    """READY, UNREADY and READY again, however many ticks pass in between."""
    bench = Bench()
    for ready in (True, True, False, False, True, True):
        bench.ready = ready
        for _ in range(3):
            bench.reconciler.tick()
            bench.run()
            bench.now += 2.0
    assert bench.kinds() == [
        EventKind.LAUNCH,
        EventKind.READY,
        EventKind.UNREADY,
        EventKind.READY,
    ]


def test_machine_that_history_lacks_is_adopted() -> None:
    """The cloud's list is the record: a lost history costs no machine."""
    bench = Bench()
    for _ in range(5):
        bench.reconciler.tick()
        bench.run()
        bench.now += 2.0
    bench.store.events.clear()
    bench.store.reopen()
    successor = Bench()
    successor.store.published = bench.store.published
    reconciler = Reconciler(
        bench.cloud,
        successor.store,
        clock=lambda: Reading(*[bench.now] * 3),
        links=bench.links,
        epoch=2,
    )
    tick = reconciler.tick()
    assert (tick.plan.launches, tick.plan.terminations) == ((), ())
    assert successor.store.history().generations[0] == 1


def test_order_that_cannot_be_built_launches_nothing() -> None:
    """An error while certificates are made leaves no trace in history or cloud."""
    bench = Bench()

    def fail(identity: Identity, asked: object, planned: PlannedLaunch) -> None:
        raise StateError("no CA")

    reconciler = Reconciler(
        bench.cloud,
        bench.store,
        clock=lambda: Reading(*[bench.now] * 3),
        links=bench.links,
        build_order=fail,  # type: ignore[arg-type]
    )
    assert reconciler.tick().plan.notes[-1].words == "no CA"
    assert bench.store.events == []
    assert bench.cloud.calls.launched == []


def test_a_full_disk_keeps_no_machine() -> None:
    """A machine that failed is ended, though neither robots nor a successor's files are told."""
    bench = Bench()
    bench.cloud.zones["east/one/a"].fails = "error"
    bench.reconciler.tick()
    bench.run()
    bench.now += 100.0

    def full(*_: object) -> None:
        raise StateError("no space left")

    bench.reconciler.build_order = full  # type: ignore[assignment]
    bench.store.write_membership = full  # type: ignore[method-assign]
    for _ in range(3):
        assert bench.reconciler.tick().plan.notes[-1].words == "no space left"
        bench.run()
    assert bench.cloud.calls.terminated == [ID]
    assert bench.kinds()[1:] == [EventKind.FAILED, EventKind.ENDING, EventKind.ENDED]


def test_a_gateway_that_cannot_be_launched_keeps_no_machine() -> None:
    """Its order may fail for as long as the disk is full; status says why replicas wait."""
    bench = Bench()
    bench.cloud.zones["east/one/a"].fails = "error"
    bench.reconciler.tick()
    bench.run()
    bench.now += 100.0

    def full(inputs: object) -> None:
        raise StateError("no space left")

    pool = replace(bench.store.spec(), gateway=LaunchedGateway(launch=True))
    bench.store.spec = lambda: pool  # type: ignore[method-assign]
    bench.reconciler.gateway = SimpleNamespace(look=full)  # type: ignore[assignment]
    tick = bench.reconciler.tick()
    bench.run()
    assert tick.plan.notes[-1].words == "no space left"
    assert (bench.cloud.calls.launched, bench.cloud.calls.terminated) == ([ID], [ID])


def test_prices_are_kept_while_the_cloud_is_away_for_prices() -> None:
    """Old prices are better than none; a changed `resources` makes them useless."""
    bench = Bench()
    bench.reconciler.tick()
    bench.run()
    bench.now += 100.0
    bench.cloud.fail_next("offers", CloudUnreachable("?"))
    tick = bench.reconciler.tick()
    assert len(tick.observed.offers) == 2
    assert any(note.cause is Cause.NO_PRICES for note in tick.plan.notes)


def test_events_are_one_per_line_facts() -> None:
    """A history event is what it says: time, kind, replica, place and reason."""
    bench = Bench()
    bench.reconciler.tick()
    assert bench.store.events == [
        Event(
            *(NOW, EventKind.LAUNCH, 0, 1, "east/one/a", Reason(Cause.NEW_SLOT)),
            version=bench.store.spec().replica_hash,
        )
    ]
