"""Turn needs into planned launches, within surge, budget and offers. Pure.

Not here: which offer is preferred (`placement`) and which launches are needed (`needs`).
"""

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

from fogft.model.choices import Spread
from fogft.model.groups import Group, group_of, is_stand_in, replica_hash
from fogft.model.reason import MOVES, Cause, Reason, because
from fogft.model.replica import Offer, Placement
from fogft.planning.classification import Classification
from fogft.planning.listing import Listing, Scale, catalogue
from fogft.planning.needs import Need
from fogft.planning.observed.backoff import (
    EVERYWHERE,
    Backoff,
    backing_off,
    backing_off_longest,
    lost_lately,
    recently_failed,
)
from fogft.planning.observed.hazard import UNKNOWN, hazards, penalty
from fogft.planning.observed.health import Assessment, Verdict
from fogft.planning.observed.launches import LAUNCHES_AN_HOUR, given_up, within_an_hour
from fogft.planning.placement import Choice, Market
from fogft.planning.sizing import Inputs, Size


class PlannedLaunch(NamedTuple):
    """A machine to order for a slot, under a new generation; a standby keeps its own."""

    slot: int
    generation: int
    offer: Offer
    reason: Reason


@dataclass
class Buyer:
    """Plans launches one by one."""

    inputs: Inputs
    machines: Classification
    sized: Size
    standing_in: Sequence[Assessment] = ()  # on-demand machines that serve until spot ones do
    launches: list[PlannedLaunch] = field(default_factory=list)
    notes: list[Reason] = field(default_factory=list)
    ended_for_room: list[tuple[Assessment, Reason]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.spec, self.intent, self.observed, self.history = self.inputs
        self.groups, self.cap = self.sized.groups, self.sized.max_usd_per_hour
        self._catalogue = catalogue(self.observed.offers)
        self._markets: dict[tuple[object, ...], Market] = {}
        self.scale = Scale(self.spec.placement.latency_weight, self.observed.rtt_s, self.spec.name)
        wrong = self._catalogue.impossible
        if wrong:
            self.notes.append(Reason(Cause.IMPOSSIBLE_PRICE, location=wrong))

    @cached_property
    def _spent_before(self) -> float:
        return sum(self.price(s) for s in self.machines.everyone())

    @property
    def _spent(self) -> float:
        return sum((launch.offer.usd_per_hour for launch in self.launches), self._spent_before)

    @cached_property
    def _backing_off(self) -> Mapping[str, Backoff]:
        return backing_off(self.history, self.observed.now)

    @cached_property
    def _retried_at(self) -> float:
        return self.history.by_clock(self.intent.retried_at)

    @cached_property
    def _lost_lately(self) -> Collection[str]:
        return lost_lately(self.history, self.observed.now)

    @property
    def budget(self) -> float | None:
        """The most that one more machine may cost now; None for no limit."""
        return None if self.cap is None else self.cap - self._spent

    def buy(self, need: Need, room: int) -> bool:
        """Plan one launch; False (and a note) when nothing more can be launched now."""
        if len(self.launches) >= room:
            if need.stands_in:
                return False
            old = need.replaces.id.short if need.replaces else ""
            self.notes.append(Reason(Cause.SURGE_FULL, slot=need.slot, replica=old))
            return False
        hopeless = given_up(self.history, replica_hash(self.spec, need.slot), self._retried_at)
        if hopeless is not None:
            self.notes.append(hopeless)
            return False
        choice, reason = self._choose(need, self.budget)
        if choice.offer is None:
            self.notes.append(Reason(Cause.WAITS, slot=need.slot, because=because(choice.why_not)))
            if self.cap is not None:
                self._make_room(need, self.cap)
            return False
        if not self._is_within_limit(on_demand=not choice.offer.placement.spot):
            return False
        generation = self.next_generation(need.slot)
        self.launches.append(PlannedLaunch(need.slot, generation, choice.offer, reason))
        return True

    def _is_within_limit(self, *, on_demand: bool) -> bool:
        """Whether the hourly limit of a market allows one more launch; adds a note if not."""
        had = within_an_hour(self.history, self.observed.now, self._retried_at, on_demand=on_demand)
        planned = sum(x.offer.placement.spot is not on_demand for x in self.launches)
        usual = sum(group.replicas for group in self.groups)  # the pool's size before a scale-down
        most = LAUNCHES_AN_HOUR * max(1, usual, self.sized.total)
        if len(had) + planned < most:
            return True
        self.notes.append(Reason(Cause.LAUNCH_LIMIT, count=most))
        return False

    def market(self, group: Group, spot: bool | None, *, at_leisure: bool = False) -> Market:
        """Return the offers for a group, spot or on-demand only unless `spot` is None.

        For a launch that can wait (`at_leisure`), supplies that failed lately are left out.
        """
        full = self._full(group) if spot else frozenset()
        key = (group.name, spot, at_leisure, full)
        if key not in self._markets:
            backing_off = self._backing_off
            if at_leisure:
                backing_off = {**recently_failed(self.history, self.observed.now), **backing_off}
            self._markets[key] = self._market(group, spot, backing_off, full)
        return self._markets[key]

    def _market(
        self,
        group: Group,
        spot: bool | None,
        backing_off: Mapping[str, Backoff],
        full: Collection[str] = (),
    ) -> Market:
        return Market(
            self._listing(group, spot),
            backing_off=backing_off,
            avoid=[*self._lost_lately, *(s.placement.location for s in self.machines.lost)],
            full=full,
            hazards=self.hazards,
        )

    def _full(self, group: Group) -> frozenset[str]:
        """Return the locations with enough of a group's replicas, if on-demand can stand in."""
        if not group.on_demand.fallback or len(self._listing(group, True).supplies) < 2:
            return frozenset()
        if not self.market(group, False).rows:
            return frozenset()
        count = Counter(
            place.location
            for slot, place in self._placed()
            if place.spot and group_of(self.groups, slot) is group
        )
        half = max(1, math.ceil(group.replicas / 2))
        most = 1 if self.spec.spread is Spread.REQUIRE else half
        return frozenset(location for location, held in count.items() if held >= most)

    @cached_property
    def hazards(self) -> Mapping[str, float]:
        """Location -> losses of spot machines per hour."""
        return hazards(self.history, self.observed.now)

    def losses_per_hour(self, placement: Placement) -> float:
        """Return the loss rate of a placement's machines; 0 on demand."""
        return self.hazards.get(placement.location, UNKNOWN) if placement.spot else 0.0

    def score(self, placement: Placement, usd_per_hour: float) -> float:
        """Return the score of a placement: price, distance and losses. Lower is better."""
        found = self.scale.of_price(usd_per_hour)
        found += self.scale.of_distance(self.scale.latency(placement))
        if placement.spot:
            found += penalty(self.losses_per_hour(placement)) - penalty(UNKNOWN)
        return found

    def whole_market(self, group: Group, spot: bool | None) -> Market:
        """Return the offers for a group as if no location were backing off."""
        key = (group.name, spot)
        if key not in self._markets:
            self._markets[key] = Market(self._listing(group, spot), hazards=self.hazards)
        return self._markets[key]

    def _listing(self, group: Group, spot: bool | None) -> Listing:
        return self._catalogue.listing(group.name, spot, self.intent.excluded, self.scale)

    def _in_spite(self, group: Group, spot: bool | None) -> Market | None:
        """Return the market of the supply that failed longest ago if all back off; None to wait."""
        coming = self.launches or any(
            not s.ever_ready for s in self.machines.good if s not in self.standing_in
        )
        if coming or EVERYWHERE in self._backing_off:
            return None
        supply = backing_off_longest(
            self.market(group, spot).backing_off.items(), self.observed.now
        )
        if supply is None:
            return None
        backing_off = {k: v for k, v in self._backing_off.items() if k != supply}
        return self._market(group, spot, backing_off, self._full(group) if spot else ())

    def kind(self, group: Group, without: Assessment | None) -> bool | None:
        """Return whether a group's next machine is spot; None if either will do."""
        if not group.on_demand.base and not group.on_demand.fallback:
            return None
        on_demand = sum(
            not place.spot
            for slot, place in self._placed(without)
            if group_of(self.groups, slot) is group and not is_stand_in(slot)
        )
        return on_demand >= group.on_demand.base

    def _placed(self, without: Assessment | None = None) -> list[tuple[int, Placement]]:
        """Return the slot and placement of each working replica and planned launch."""
        stay = (*self.machines.good, *self.machines.replaced)
        placed = [(s.slot, s.placement) for s in stay if s is not without]
        return placed + [(launch.slot, launch.offer.placement) for launch in self.launches]

    def places(self, without: Assessment | None, *, lasting: bool = False) -> list[Placement]:
        """Return current and planned placements; `lasting` leaves out stand-ins."""
        placed = self._placed(without)
        return [place for slot, place in placed if not (lasting and is_stand_in(slot))]

    def price(self, replica: Assessment) -> float:
        """Return a machine's current price if known, else the price it was ordered at."""
        group = group_of(self.groups, replica.slot).name
        return self._catalogue.today.get((group, replica.placement), replica.machine.usd_per_hour)

    def _choose(self, need: Need, budget: float | None) -> tuple[Choice, Reason]:
        old = need.replaces
        avoid = set()
        why = old.why if old is not None else None
        moves = why is not None and why.cause in MOVES
        is_outdated = why is not None and why.cause is Cause.OUTDATED
        if old is not None and not (moves or is_outdated):  # the location is at fault
            avoid.add(old.placement.location)
        taken = self.places(old, lasting=not need.stands_in)
        spot = False if need.stands_in else self.kind(need.group, old)
        market = self.market(need.group, spot, at_leisure=moves)
        found = market.choose(taken, avoid=avoid, budget_usd_per_hour=budget)
        last = None if found.offer or moves else self._in_spite(need.group, spot)
        if last is not None:
            choice = last.choose(taken, avoid=avoid, budget_usd_per_hour=budget)
            also = (*need.reason.because, Reason(Cause.FAILED_LONGEST_AGO))
            return choice, replace(need.reason, because=also)
        return found, need.reason

    def _make_room(self, need: Need, cap: float) -> None:
        """Under a cap, end a silent machine first if it blocks its own replacement."""
        going = [*self.machines.ending, *(s for s, _ in self.ended_for_room)]
        left = cap - self._spent + sum(map(self.price, going))
        if self._choose(need, left)[0].offer is not None:
            return  # the machines that are ending make enough room
        for replica in self.machines.lost:
            if replica.verdict is not Verdict.UNRESPONSIVE or replica in going:
                continue
            if self._choose(need, left + self.price(replica))[0].offer is not None:
                full = Reason(Cause.BUDGET_FULL, because=because(replica.why))
                self.ended_for_room.append((replica, full))
                return

    def fits_beside(self, need: Need) -> bool:
        """Whether the budget has room for a successor beside the replica that it replaces."""
        return self._choose(need, self.budget)[0].offer is not None

    def fits_instead(self, need: Need, old: Assessment) -> bool:
        """Whether the budget has room for a successor once the replica it replaces is gone."""
        if self.cap is None:
            return True
        left = self.cap - self._spent + self.price(old)
        return self._choose(need, left)[0].offer is not None

    def next_generation(self, slot: int) -> int:
        """Return the generation of a slot's next launch."""
        listed = [s.id.generation for s in self.machines.everyone() if s.slot == slot]
        known = [self.history.generations[slot], self.intent.drained.get(slot, 0)]
        return max([*known, *listed]) + 1
