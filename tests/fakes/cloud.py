"""A cloud in memory, under simulated time: it records calls and does what it is told to.

It keeps the whole contract of the port, and can be made to fail in every way that the
contract names. What a machine's state is follows from the time alone, so nothing runs
in the background and a test is as fast as it can be computed.

Owns: offers, capacity, boot times, preemption, outages and injected errors.
Not here: what replicas do once they run (`tests/simulation`).
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any

from fogft.cloud.port import Launch
from fogft.errors import CloudError, CloudUnreachable, NoCapacity, SpecError
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Machine, MachinePhase, Offer, Placement, ReplicaId

_BY_ID = attrgetter("id.pool_uid", "id.slot", "id.generation")


@dataclass
class Zone:
    """A location of the mock cloud.

    Attributes:
        boot_s: Shortest and longest time from launch to running.
        capacity: Machines that fit; None for any number.
        fails: Cause with which machines launched here will fail; empty for none.
    """

    placement: Placement
    usd_per_hour: float
    boot_s: tuple[float, float] = (1.0, 3.0)
    capacity: int | None = None
    fails: str = ""


@dataclass
class _Vm:
    order: Launch
    launched_at: float
    runs_at: float
    fails: str
    notice_at: float = float("inf")
    gone_at: float = float("inf")
    shown: Machine | None = None  # as it was when last looked at

    def at(self, now: float) -> Machine:
        """Return the machine as it is; the same object for as long as nothing changes."""
        phase = MachinePhase.PROVISIONING
        if now >= self.runs_at:
            phase = MachinePhase.FAILED if self.fails else MachinePhase.RUNNING
        notice, shown = now >= self.notice_at, self.shown
        if shown is None or (shown.phase, shown.notice) != (phase, notice):
            self.shown = shown = self._as(phase, notice)
        return shown

    def _as(self, phase: MachinePhase, notice: bool) -> Machine:
        order, running = self.order, phase is MachinePhase.RUNNING
        return Machine(
            id=order.id,
            placement=order.placement,
            phase=phase,
            launched_at=self.launched_at,
            endpoint=f"127.0.0.1:{20_000 + hash_port(order.id)}" if running else None,
            notice=notice,
            usd_per_hour=order.usd_per_hour,
            spec_hash=order.spec_hash,
            failure=Reason(Cause(self.fails)) if phase is MachinePhase.FAILED else None,
        )


@dataclass
class Calls:
    """What was asked of the cloud, in order."""

    launched: list[ReplicaId] = field(default_factory=list)
    terminated: list[ReplicaId] = field(default_factory=list)
    listed: int = 0


def zones(*names: str, usd_per_hour: float = 0.1) -> list[Zone]:
    """Make zones from locations such as ``mock/east/a``, each a little dearer than the last."""
    out = []
    for index, name in enumerate(names):
        cloud, region, zone = name.split("/")
        placement = Placement(cloud, region, zone, "m1")
        out.append(Zone(placement, usd_per_hour * (1 + index / 100)))
    return out


class MockCloud:
    """See the module. Implements `fogft.cloud.port.Cloud`.

    Args:
        clock: Simulated seconds; only ever grows.
        zones: Where machines can run.
        seed: Of the boot times.
    """

    def __init__(self, clock: Callable[[], float], zones: Sequence[Zone], *, seed: int = 0) -> None:
        self.zones = {zone.placement.location: zone for zone in zones}
        self.calls = Calls()
        self.unreachable = False
        self._clock = clock
        self._random = random.Random(seed)
        self.vms: dict[ReplicaId, _Vm] = {}
        self.errors: dict[str, list[CloudError]] = {}

    # -- the port -------------------------------------------------------------------------

    def offers(self, resources: Mapping[str, Any]) -> Sequence[Offer]:
        """List every zone; `resources` may narrow it by ``region``."""
        self._meet("offers")
        region = resources.get("region")
        found = [
            Offer(zone.placement, zone.usd_per_hour)
            for zone in self.zones.values()
            if region in (None, zone.placement.region)
        ]
        if not found:
            raise SpecError.of_key("resources.region", f"`{region}` does not exist")
        return found

    def machines(self, pool_uid: str) -> Sequence[Machine]:
        """List the pool's machines as they are at this moment of simulated time."""
        self._meet("machines")
        self.calls.listed += 1
        return [machine for machine in self.present() if machine.id.pool_uid == pool_uid]

    def launch(self, order: Launch) -> None:
        """Order a machine; it runs after the zone's boot time."""
        self._meet("launch")
        if order.id in self.vms:
            return
        zone = self.zones[order.placement.location]
        here = sum(m.placement.location == zone.placement.location for m in self.present())
        if zone.capacity is not None and here >= zone.capacity:
            raise NoCapacity(f"no capacity in `{zone.placement.location}`")
        now = self._clock()
        self.calls.launched.append(order.id)
        boot_s = self._random.uniform(*zone.boot_s)
        self.vms[order.id] = _Vm(order, now, now + boot_s, zone.fails)

    def terminate(self, id: ReplicaId) -> None:
        """End a machine at once."""
        self._meet("terminate")
        self.calls.terminated.append(id)
        vm = self.vms.get(id)
        if vm is not None:
            vm.gone_at = min(vm.gone_at, self._clock())

    def log(self, id: ReplicaId) -> str | None:
        """Keep no log."""
        return None

    # -- what tests do to it ----------------------------------------------------------------

    def present(self) -> list[Machine]:
        """Return the machines of all pools, whatever `machines` is told to answer."""
        now = self._clock()
        return sorted((vm.at(now) for vm in self.vms.values() if now < vm.gone_at), key=_BY_ID)

    def machine(self, id: ReplicaId) -> Machine | None:
        """Return one of them, None if it is not there."""
        vm, now = self.vms.get(id), self._clock()
        return vm.at(now) if vm and now < vm.gone_at else None

    def fail_next(self, operation: str, error: CloudError) -> None:
        """Let the next call of an operation (``launch``, ``machines``, ...) raise an error."""
        self.errors.setdefault(operation, []).append(error)

    def preempt(self, id: ReplicaId, *, notice_s: float = 0.0) -> None:
        """Take a machine away, after a notice if `notice_s` is positive."""
        vm, now = self.vms[id], self._clock()
        if notice_s > 0:
            vm.notice_at = min(vm.notice_at, now)
        vm.gone_at = min(vm.gone_at, now + notice_s)

    def _meet(self, operation: str) -> None:
        if self.errors.get(operation):
            raise self.errors[operation].pop(0)
        if self.unreachable:
            raise CloudUnreachable("the mock cloud is told to be unreachable")


def hash_port(id: ReplicaId) -> int:
    """Return a number below 40 000 that differs between the replicas of small pools."""
    return (id.slot * 997 + id.generation) % 40_000
