"""What fogft is compared with: fixed policies, on the same machines and prices.

None of them acts on a preemption notice. Each sees a lost machine and hears a refusal as
soon as fogft does, and is not charged for what it needs besides its replicas.

Owns: replicas that stay where they are, and SkyServe's policy.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial

from fogft.cloud.port import Launch
from fogft.errors import NoCapacity
from fogft.model.replica import Offer, ReplicaId
from fogft.simulation.world import NEVER, Target, World

UID = "0" * 16
RETRY_S = 60.0


class Fleet:
    """Machines ordered by a fixed policy.

    Attributes:
        ordered: Each machine ordered and not yet refused, ended or missed.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.ordered: dict[ReplicaId, Offer] = {}
        self._accepted: set[ReplicaId] = set()
        self._launched = 0

    def order(self, slot: int, offer: Offer, refused: Callable[[], None]) -> None:
        """Order a machine; `refused` is called if there is no room."""
        self._launched += 1
        id = ReplicaId(UID, slot, self._launched)
        self.ordered[id] = offer
        order = Launch(id, "baseline", offer.placement, offer.usd_per_hour, "")
        self.world.submit(lambda: self._launch(order, refused))

    def _launch(self, order: Launch, refused: Callable[[], None]) -> None:
        try:
            self.world.launch(order)
        except NoCapacity:
            self.ordered.pop(order.id, None)
            refused()
        else:
            self._accepted.add(order.id)

    def end(self, id: ReplicaId) -> None:
        """End a machine."""
        del self.ordered[id]
        self.world.submit(lambda: self.world.terminate(id))

    def missed(self) -> list[tuple[ReplicaId, Offer]]:
        """Return, and forget, the machines that were taken away."""
        gone = [id for id in self.ordered if id in self._accepted and id not in self.world.vms]
        return [(id, self.ordered.pop(id)) for id in gone]

    def ready(self, id: ReplicaId) -> bool:
        """Whether a machine serves."""
        vm = self.world.vms.get(id)
        return vm is not None and vm.ready


class Static:
    """One machine for each offer given, ordered again there whenever it is lost or refused."""

    def __init__(self, world: World, offers: Sequence[Offer], wanted: Target) -> None:
        self._fleet = Fleet(world)
        self._offers = offers
        self.wanted = wanted
        self._due = dict.fromkeys(range(len(offers)), world.now)

    def tick(self, now: float) -> float:
        """Order what is missing."""
        for id, _ in self._fleet.missed():
            self._due[id.slot] = now
        for slot in [slot for slot, at in self._due.items() if at <= now]:
            del self._due[slot]
            self._fleet.order(slot, self._offers[slot], partial(self._retry, slot))
        return min(self._due.values(), default=NEVER)

    def _retry(self, slot: int) -> None:
        self._due[slot] = self._fleet.world.now + RETRY_S


class SkyServe:
    """SkyServe's spot placer, with or without its on-demand fallback.

    A location is active until a replica is lost or refused there, and again once one becomes
    ready; when fewer than two are active, all are. A launch goes to the cheapest active
    location with the fewest replicas. For each spot replica that is not ready an on-demand
    one runs in its place. After a refusal in every location it waits a minute.
    """

    def __init__(
        self,
        world: World,
        spot: Sequence[Offer],
        on_demand: Offer | None,
        replicas: int,
        wanted: Target,
    ) -> None:
        self.wanted = wanted
        self._fleet = Fleet(world)
        self._spot = spot
        self._on_demand = on_demand
        self._replicas = replicas
        self._preempted: set[str] = set()
        self._seen_ready: set[ReplicaId] = set()
        self._refused_in_a_row = 0
        self._spot_from = world.now

    def tick(self, now: float) -> float:
        """Order and end what the policy says."""
        fleet = self._fleet
        for _, offer in fleet.missed():
            self._mark(offer)
        spot = [id for id, offer in fleet.ordered.items() if offer.placement.spot]
        for id in spot:
            if id not in self._seen_ready and fleet.ready(id):
                self._seen_ready.add(id)
                self._preempted.discard(fleet.ordered[id].placement.location)
        if self._spot and now >= self._spot_from:
            for slot in range(len(spot), self._replicas):
                offer = self._place()
                fleet.order(slot, offer, partial(self._refused, offer))
        self._fall_back(self._replicas - sum(map(fleet.ready, spot)))
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

    def _place(self) -> Offer:
        used = Counter(o.placement.location for o in self._fleet.ordered.values())
        active = [o for o in self._spot if o.placement.location not in self._preempted]
        return min(
            active,
            key=lambda o: (used[o.placement.location], o.usd_per_hour, o.placement),
        )

    def _mark(self, offer: Offer) -> None:
        self._preempted.add(offer.placement.location)
        locations = {o.placement.location for o in self._spot}
        if len(locations - self._preempted) < 2:
            self._preempted.clear()

    def _refused(self, offer: Offer) -> None:
        self._mark(offer)
        self._refused_in_a_row += 1
        if self._refused_in_a_row >= len({o.placement.location for o in self._spot}):
            self._refused_in_a_row = 0
            self._spot_from = self._fleet.world.now + RETRY_S
