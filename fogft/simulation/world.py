"""A cloud and its machines under simulated time, event by event.

Between two events nothing changes, so time jumps from one to the next. A policy is called
after each event, and when it asked to be; it acts through the cloud port only.

Not here: the policies (`managed`, `baselines`) and the market's changes (`market`).
"""

import heapq
import itertools
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

from fogft.cloud.port import Launch
from fogft.errors import CloudError, NoCapacity, QuotaExceeded
from fogft.model.replica import LinkReport, Machine, MachinePhase, Offer, Placement, ReplicaId
from fogft.planning.placement import crowding
from fogft.simulation.market import Change, Market, changes, remembered, rounded_up
from fogft.simulation.meter import Meter
from fogft.simulation.model import SLOW
from fogft.simulation.timeline import PER_USD

EPOCH = 1_704_067_200.0  # a Monday, 00:00 UTC: simulated time is a time of day as well
TICK_S = 1.0
NEVER = float("inf")
UNSEEN = object()

Happening = Callable[[], object]
Target = Callable[[float], int]


class Policy(Protocol):
    """The interface of a policy, which orders and ends machines."""

    wanted: Target  # how many replicas the pool file wants ready at a time

    def tick(self, now: float) -> float:
        """Act on the current state; return when to be called again if nothing happens."""


@dataclass(eq=False)
class Vm:
    """A machine. Times in seconds since the epoch."""

    order: Launch
    launched_at: float
    ready: bool = False  # it runs and its service answers
    noticed: bool = False
    gone_at: float = NEVER  # when it was lost; it may still be listed
    machine: Machine | None = None  # as listed; None if it must be rebuilt
    report: LinkReport | None = None  # of its link while it answers; None likewise


class World:
    """One market with one pool in it. Implements `fogft.cloud.port.Cloud`.

    What happens before `settle_s` is not measured.
    """

    def __init__(
        self, market: Market, *, seed: int, length_s: float, settle_s: float = 0.0
    ) -> None:
        self.now = EPOCH
        self.market = market
        self.vms: dict[ReplicaId, Vm] = {}
        self.meter = Meter(EPOCH + settle_s)
        self.asked = 0  # how often the policy was called
        # Of a policy that watches links: how long after a loss it can notice that, and whether it
        # then does. Any other policy sees a loss at once.
        self.silences: Sequence[tuple[float, Callable[[], bool]]] = ()
        self._find = remembered(market.offers)
        self._until = EPOCH + length_s
        self._chance = random.Random(f"machines {seed}")
        self._capacity: dict[str, int] = {}
        self._queue: list[tuple[float, int, Happening]] = []
        self._order = itertools.count()
        self._prices: dict[str, float] = {}  # location -> recorded spot price
        for place, line in market.prices.items():
            for at_s, price in line.changes:
                self.at(EPOCH + rounded_up(at_s, TICK_S), partial(self._reprice, place, price))
        for change in changes(market, TICK_S):
            if change.at_s <= length_s:
                self.at(EPOCH + change.at_s, partial(self._change, change))

    # -- time -------------------------------------------------------------------------------

    def at(self, time: float, happen: Happening) -> None:
        """Schedule an event; `happen` returns `UNSEEN` if the policy cannot notice it."""
        heapq.heappush(self._queue, (max(time, self.now), next(self._order), happen))

    def after(self, seconds: float, happen: Happening) -> None:
        """Schedule an event after a delay, rounded up to whole ticks."""
        self.at(self.now + rounded_up(seconds, TICK_S), happen)

    def run(self, policy: Policy) -> Meter:
        """Run a policy until the end."""
        wake = self.now
        while True:
            due = self._queue[0][0] if self._queue else NEVER
            moment = min(wake, due)
            if moment >= self._until:
                self._pass_until(self._until, policy)
                return self.meter
            self._pass_until(moment, policy)
            seen = self.now >= wake
            while self._queue and self._queue[0][0] <= self.now:
                seen |= heapq.heappop(self._queue)[2]() is not UNSEEN
            if not seen:
                continue
            self.asked += 1
            wake = max(rounded_up(policy.tick(self.now), TICK_S), self.now + TICK_S)

    def _pass_until(self, moment: float, policy: Policy) -> None:
        if moment > self.now:
            ready, usd_per_hour = 0, 0.0
            for vm in self.vms.values():
                if vm.gone_at == NEVER:
                    ready += vm.ready
                    usd_per_hour += self._price(vm.order.placement, vm.order.usd_per_hour)
            self.meter.pass_time(
                moment,
                moment - self.now,
                ready=ready,
                wanted=policy.wanted(self.now),
                usd_per_hour=usd_per_hour,
            )
            self.now = moment

    # -- the market ---------------------------------------------------------------------------

    def _change(self, change: Change) -> object:
        self._capacity[change.location] = change.capacity
        here = self._spot_machines(change.location)
        excess = len(here) - change.capacity
        if excess <= 0:
            return UNSEEN
        for vm in self._chance.sample(here, excess):
            if EPOCH + change.ends_s > self.now:
                vm.noticed = True
                vm.machine = vm.report = None
            self.at(EPOCH + change.ends_s, partial(self._lose, vm))
        return None

    def _reprice(self, place: str, price: int) -> None:
        self._prices[place] = price / PER_USD
        self._find = remembered(self._sold)

    def _sold(self, resources: Mapping[str, Any]) -> Sequence[Offer]:
        """Return the market's offers at current prices."""
        return [
            replace(offer, usd_per_hour=self._price(offer.placement, offer.usd_per_hour))
            for offer in self.market.offers(resources)
        ]

    def _price(self, place: Placement, usual: float) -> float:
        return self._prices.get(place.location, usual) if place.spot else usual

    def _spot_machines(self, location: str) -> list[Vm]:
        """Return the spot machines that use capacity there: not gone, and without a notice."""
        return [
            vm
            for vm in self.vms.values()
            if vm.order.placement.spot
            and vm.order.placement.location == location
            and vm.gone_at == NEVER
            and not vm.noticed
        ]

    def _lose(self, vm: Vm) -> object:
        if vm.order.id not in self.vms or vm.gone_at != NEVER:
            return UNSEEN  # it was ended before
        vm.gone_at, vm.ready = self.now, False
        self.meter.preemptions += self.meter.counts(self.now)
        for silence_s, is_felt in self.silences:
            self.after(silence_s, partial(self._fall_silent, vm, is_felt))
        self.after(self.market.timing.detect_s, lambda: self._forget(vm))
        return UNSEEN if self.silences else None

    def _fall_silent(self, vm: Vm, is_felt: Callable[[], bool]) -> object:
        return None if vm.order.id in self.vms and is_felt() else UNSEEN

    def _forget(self, vm: Vm) -> object:
        return UNSEEN if self.vms.pop(vm.order.id, None) is None else None

    def _boot(self, vm: Vm) -> None:
        if vm.order.id in self.vms and vm.gone_at == NEVER:
            vm.ready, vm.machine = True, None

    # -- the cloud port -----------------------------------------------------------------------

    def submit(self, call: Happening) -> None:
        """Submit a cloud call, which takes simulated time."""
        self.after(self.market.timing.answer_s, call)

    def offers(self, resources: Mapping[str, Any]) -> Sequence[Offer]:
        """List the market's offers, full locations included."""
        return self._find(resources)

    def machines(self, pool_uid: str) -> Sequence[Machine]:
        """List the machines, including lost ones not noticed yet."""
        return [vm.machine or _listed(vm) for vm in self.vms.values()]

    def launch(self, order: Launch) -> None:
        """Start a machine if there is capacity."""
        if order.id in self.vms:
            return
        timing, place = self.market.timing, order.placement
        refusal = self._refusal(place)
        if refusal is not None:
            self.meter.refusals += self.meter.counts(self.now)
            raise refusal
        vm = self.vms[order.id] = Vm(order, self.now)
        self.meter.launches += self.meter.counts(self.now)
        boot_s = timing.boot_s * self._chance.uniform(0.75, 1.25)
        if self._happens(timing.slow_setup):
            boot_s *= SLOW
        fails = self._happens(timing.launch_fails)
        self.after(
            max(boot_s - timing.answer_s, 0.0),
            lambda: self._forget(vm) if fails else self._boot(vm),
        )
        if not place.spot and timing.on_demand_mttf_s:
            lives_s = self._chance.expovariate(1 / timing.on_demand_mttf_s)
            self.after(lives_s, lambda: self._lose(vm))

    def _happens(self, share: float) -> bool:
        return bool(share) and self._chance.random() < share

    def _refusal(self, place: Placement) -> CloudError | None:
        """Return why an order is refused; None if it is accepted."""
        timing = self.market.timing
        if not place.spot:
            refused = self._happens(timing.on_demand_refused)
            return NoCapacity(f"no capacity in `{place.location}`") if refused else None
        if self._capacity.get(place.location, 0) <= len(self._spot_machines(place.location)):
            return NoCapacity(f"no capacity in `{place.location}`")
        region = place.domains[1]
        spot = crowding(vm.order.placement for vm in self.vms.values() if vm.order.placement.spot)
        if timing.spot_quota and spot[region] >= timing.spot_quota:
            return QuotaExceeded(f"no more spot machines in `{region}`")
        return None

    def terminate(self, id: ReplicaId) -> None:
        """End a machine at once."""
        self.vms.pop(id, None)

    def log(self, id: ReplicaId) -> str | None:
        """Keep no log."""
        return None


def _listed(vm: Vm) -> Machine:
    order = vm.order
    vm.machine = Machine(
        id=order.id,
        placement=order.placement,
        phase=MachinePhase.RUNNING if vm.ready else MachinePhase.PROVISIONING,
        launched_at=vm.launched_at,
        endpoint=order.id.short if vm.ready else None,
        notice=vm.noticed,
        usd_per_hour=order.usd_per_hour,
        spec_hash=order.spec_hash,
    )
    return vm.machine
