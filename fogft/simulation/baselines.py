"""Fixed policies that fogft is compared with, on the same machines and prices.

Each sees a notice, a lost machine and a refusal as soon as fogft does, and is charged for its
replicas only. `Search` replaces a machine with a notice at once; it serves until it ends.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial

from fogft.cloud.port import Launch
from fogft.errors import CloudError
from fogft.model.replica import Offer, ReplicaId
from fogft.simulation.world import NEVER, Target, World

UID = "0" * 16
RETRY_S = 60.0


class Fleet:
    """Machines ordered by a fixed policy."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.ordered: dict[ReplicaId, Offer] = {}  # not yet refused, ended or missed
        self._accepted: set[ReplicaId] = set()
        self._launched = 0

    def order(self, slot: int, offer: Offer, refused: Callable[[], None]) -> None:
        """Order a machine; `refused` is called if there is no capacity."""
        self._launched += 1
        id = ReplicaId(UID, slot, self._launched)
        self.ordered[id] = offer
        order = Launch(id, "baseline", offer.placement, offer.usd_per_hour, "")
        self.world.submit(lambda: self._launch(order, refused))

    def _launch(self, order: Launch, refused: Callable[[], None]) -> None:
        try:
            self.world.launch(order)
        except CloudError:
            self.ordered.pop(order.id, None)
            refused()
        else:
            self._accepted.add(order.id)

    def end(self, id: ReplicaId) -> None:
        """End a machine."""
        del self.ordered[id]
        self.world.submit(lambda: self.world.terminate(id))

    def missed(self) -> list[tuple[ReplicaId, Offer]]:
        """Remove and return the preempted machines."""
        gone = [id for id in self.ordered if id in self._accepted and id not in self.world.vms]
        return [(id, self.ordered.pop(id)) for id in gone]

    def ready(self, id: ReplicaId) -> bool:
        """Whether a machine serves, and has no notice."""
        vm = self.world.vms.get(id)
        return vm is not None and vm.ready and not vm.noticed


class Static:
    """One machine for each given offer, ordered again whenever it is lost or refused."""

    def __init__(self, world: World, offers: Sequence[Offer], wanted: Target) -> None:
        self._fleet = Fleet(world)
        self._offers = offers
        self.wanted = wanted
        self._due = dict.fromkeys(range(len(offers)), world.now)

    def tick(self, now: float) -> float:
        """Order missing machines."""
        for id, _ in self._fleet.missed():
            self._due[id.slot] = now
        for slot in [slot for slot, at in self._due.items() if at <= now]:
            del self._due[slot]
            self._fleet.order(slot, self._offers[slot], partial(self._retry, slot))
        return min(self._due.values(), default=NEVER)

    def _retry(self, slot: int) -> None:
        self._due[slot] = self._fleet.world.now + RETRY_S


class Search:
    """Spot machines placed by a rule: one for each replica, and `extra` ones.

    An `on_demand` machine runs for each spot machine that is not ready, but at most one for each
    replica. After as many refusals in a row as there are locations, the search pauses for a minute.
    """

    def __init__(
        self,
        world: World,
        spot: Sequence[Offer],
        on_demand: Offer | None,
        replicas: int,
        wanted: Target,
        *,
        rule: Callable[[Sequence[Offer]], Naive],
        extra: int = 0,
    ) -> None:
        self.wanted = wanted
        self._fleet = Fleet(world)
        self._rule = rule(spot)
        self._locations = len({o.placement.location for o in spot})
        self._on_demand = on_demand
        self._replicas = replicas
        self._spots = replicas + extra
        self._seen_ready: set[ReplicaId] = set()
        self._left: set[ReplicaId] = set()
        self._refused_in_a_row = 0
        self._spot_from = world.now

    def tick(self, now: float) -> float:
        """Order and end machines."""
        fleet, rule = self._fleet, self._rule
        for id, offer in fleet.missed():
            if offer.placement.spot and id not in self._left:
                rule.lost(offer)
        kept = []
        for id, offer in fleet.ordered.items():
            if not offer.placement.spot:
                continue
            vm = fleet.world.vms.get(id)
            if vm is not None and vm.noticed:
                if id not in self._left:
                    self._left.add(id)
                    rule.lost(offer)
                continue
            kept.append(id)
            if id not in self._seen_ready and fleet.ready(id):
                self._seen_ready.add(id)
                self._refused_in_a_row = 0
                rule.ready(offer)
        if now >= self._spot_from:
            taken = [fleet.ordered[id] for id in kept]
            for slot in range(len(kept), self._spots):
                offer = rule.place(taken)
                taken.append(offer)
                fleet.order(slot, offer, partial(self._refused, offer))
        self._fall_back(min(self._replicas, self._spots - sum(map(fleet.ready, kept))))
        return self._spot_from if self._spot_from > now else NEVER

    def _fall_back(self, wanted: int) -> None:
        if self._on_demand is None:
            return
        fleet = self._fleet
        running = [id for id, offer in fleet.ordered.items() if not offer.placement.spot]
        for _ in range(len(running), wanted):
            fleet.order(len(running), self._on_demand, lambda: None)
        running.sort(key=lambda id: (fleet.ready(id), -id.generation))
        for id in running[: max(len(running) - max(wanted, 0), 0)]:
            fleet.end(id)

    def _refused(self, offer: Offer) -> None:
        self._rule.lost(offer)
        self._refused_in_a_row += 1
        if self._refused_in_a_row >= self._locations:
            self._refused_in_a_row = 0
            self._spot_from = self._fleet.world.now + RETRY_S


class Naive:
    """Where to order the next spot machine: fewest replicas, then oldest failure, then price."""

    def __init__(self, spot: Sequence[Offer]) -> None:
        self._spot = spot
        self._failed: dict[str, int] = {}
        self._preempted: set[str] = set()

    def place(self, taken: Sequence[Offer]) -> Offer:
        """Return the offer to order, given those in use."""
        used = Counter(o.placement.location for o in taken)
        return min(
            (o for o in self._spot if o.placement.location not in self._preempted),
            key=lambda o: (
                used[o.placement.location],
                self._failed.get(o.placement.location, 0),
                o.usd_per_hour,
                o.placement,
            ),
        )

    def lost(self, offer: Offer) -> None:
        """Note that a location preempted a machine or had no capacity: it is tried last."""
        self._failed[offer.placement.location] = 1 + max(self._failed.values(), default=0)

    def ready(self, offer: Offer) -> None:
        """Note that a machine became ready there."""


class InTurn(Naive):
    """Round robin: the next location of a list, wherever other replicas are."""

    def __init__(self, spot: Sequence[Offer]) -> None:
        super().__init__(spot)
        self._turns = itertools.cycle(spot)

    def place(self, taken: Sequence[Offer]) -> Offer:
        """Return the next offer."""
        return next(self._turns)


class ActiveZones(Naive):
    """SkyServe's spot placer: the cheapest active location with the fewest replicas.

    A location is active until a replica is lost or refused there, and again once one becomes
    ready; when fewer than two are active, all are.
    """

    def lost(self, offer: Offer) -> None:
        """Make a location inactive."""
        self._preempted.add(offer.placement.location)
        if len({o.placement.location for o in self._spot} - self._preempted) < 2:
            self._preempted.clear()

    def ready(self, offer: Offer) -> None:
        """Make a location active."""
        self._preempted.discard(offer.placement.location)
