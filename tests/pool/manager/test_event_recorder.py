"""What a tick has just seen counts for the plan of the same tick, though real clocks move on."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

import pytest

from fogft.model.replica import MachinePhase
from fogft.model.spec import PoolSpec
from fogft.planning.observed.clock_jumps import Reading
from fogft.pool.folder.store import Identity
from fogft.pool.manager.reconciler import Reconciler
from tests.fakes.cloud import MockCloud, zones
from tests.simulation.memory_store import MemoryStore
from tests.simulation.world import SERVICE, START, UID

PLACES = ("east/one/a", "east/one/b", "east/two/a")


class Pool:
    """One replica, under a clock that moves a millisecond each time somebody looks at it."""

    def __init__(self) -> None:
        self.now = START
        self._looks: Iterator[int] = count()
        self.cloud = MockCloud(lambda: self.now, zones(*PLACES))
        spec = PoolSpec(name="p", services=(SERVICE,), replicas=1, task={"run": "x"})
        store = MemoryStore(Identity("p", UID, "mock", "/p.yaml", START), spec)
        self.manager = Reconciler(
            self.cloud, store, clock=lambda: Reading(*[self.now + next(self._looks) / 1000] * 3),
            links=lambda uid, now: (),
        )  # fmt: skip

    def ticks(self, times: int) -> None:
        for _ in range(times):
            self.manager.tick()
            self.now += 1.0

    def place(self) -> str:
        (machine,) = self.cloud.machines(UID)
        return machine.placement.location


def test_a_replacement_never_goes_where_its_predecessor_was_just_lost() -> None:
    pool = Pool()
    pool.ticks(5)
    lost_at = pool.place()
    pool.cloud.preempt(pool.cloud.machines(UID)[0].id)
    pool.ticks(1)
    assert pool.place() != lost_at


@pytest.mark.parametrize("cause", ["capacity", "error"])
def test_a_location_that_has_just_failed_is_not_tried_again_at_once(cause: str) -> None:
    """Two zones fail: each is tried once, and the third one takes the replica."""
    pool = Pool()
    for name in PLACES[:2]:
        pool.cloud.zones[name].fails = cause
    pool.ticks(12)
    locations = [
        machine.placement.location
        for machine in pool.cloud.machines(UID)
        if machine.phase is not MachinePhase.FAILED
    ]
    assert locations == ["east/two/a"]
    assert len(pool.cloud.calls.launched) == 3
