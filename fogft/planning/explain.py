"""Explain a plan: the offers considered, those chosen, and why others were not. Pure.

Each rejected offer is compared with each chosen one, and the comparison that it came nearest to
winning is reported: an offer that lost by its score came nearer than one that lost by the spread.

Not here: the decisions (`planner`) and how they are shown (`fogft.cli`).
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import NamedTuple

from fogft.model.choices import Assumption
from fogft.model.groups import group_of, groups_of
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Offer, Placement
from fogft.planning.availability import Expected, expected, full_together, unavailability_of
from fogft.planning.buying import PlannedLaunch
from fogft.planning.cost import Cost, cost
from fogft.planning.listing import Scale, is_possible
from fogft.planning.observed.backoff import EVERYWHERE, backing_off
from fogft.planning.observed.hazard import hazards
from fogft.planning.placement import crowding
from fogft.planning.planner import plan
from fogft.planning.sizing import Inputs, size, spot_sold

NO_POOL = "0" * 16
LATELY_S = 4 * 3600.0


@dataclass(frozen=True)
class Considered:
    """An offer, the slots that got it, and why it was not chosen."""

    offer: Offer
    slots: tuple[int, ...]
    why_not: Reason | None
    rtt_s: float | None  # round trip to its region in seconds; None for not known
    losses: int  # replicas of this pool lost there in the last hours
    losses_per_hour: float | None = None  # learned there; None on demand or without history


@dataclass(frozen=True)
class Explanation:
    """A plan with its reasons, cost and expected availability, for people to read."""

    considered: tuple[Considered, ...]
    replicas: tuple[PlannedLaunch, ...]
    wanted: int
    cap: float | None  # US dollars per hour; None for none
    assumed: Assumption  # what the availability rests on
    expected: Expected  # how often a request can be answered
    target: float | None
    cost: Cost
    # The cheapest on-demand machine that could serve alone, and its cost; None without a price.
    single: tuple[Offer, Cost] | None
    notes: tuple[Reason, ...]
    # Availability and US dollars per hour if on-demand machines stood in; None if they do already,
    # or cannot.
    with_fallback: tuple[float, float] | None = None

    @property
    def is_cheapest(self) -> bool | None:
        """Whether the pool is cheaper than one on-demand machine for its target.

        Only an option that reaches the target counts; without a target, the pool's expected
        availability is the target. None if neither reaches it, or if no price is known.
        """
        if self.single is None:
            return None
        pool = self.expected.correlated
        target = pool if self.target is None else self.target
        costs = [(self.cost.usd_per_hour, True)] if pool >= target else []
        if 1.0 - unavailability_of(self.assumed, spot=False) >= target:
            costs.append((self.single[1].usd_per_hour, False))
        return min(costs)[1] if costs else None

    @property
    def round_trips_s(self) -> list[float]:
        """The known round trips to the replicas in seconds, shortest first."""
        known = [self.rtt_s(planned.offer) for planned in self.replicas]
        return sorted(rtt_s for rtt_s in known if rtt_s is not None)

    def rtt_s(self, offer: Offer) -> float | None:
        """Return the round trip to an offer that was considered; None for not known."""
        return next(one.rtt_s for one in self.considered if one.offer == offer)


def explain(
    inputs: Inputs, on_demand: Sequence[Offer] = (), *, recovery_s: float | None = None
) -> Explanation:
    """Plan a pool from scratch, whatever runs, and explain the plan.

    Args:
        inputs: Of the history, only the losses and failures of locations count.
        on_demand: Offers of one on-demand machine of this kind, for comparison.
        recovery_s: How long launches have taken; used if the file has no availability target.
    """
    spec, intent, observed, history = inputs
    inputs = inputs._replace(
        intent=replace(intent, stopping=False),
        observed=replace(observed, machines=(), links=None, ending=frozenset()),
    )
    planned = plan(NO_POOL, inputs._replace(history=history.places_alone()))
    cap = size(inputs).max_usd_per_hour
    reasons = _Reasons(inputs, planned.launches, cap)
    assumed: Assumption = spec.availability or Assumption()
    if recovery_s is not None and spec.availability is None:
        assumed = replace(assumed, recovery_s=recovery_s)
    places = [launch.offer.placement for launch in planned.launches]
    sold = spot_sold(inputs)
    full = full_together(sold, assumed)
    cheapest = min(
        (o for o in on_demand if is_possible(o)),
        key=lambda o: (o.usd_per_hour, o.placement),
        default=None,
    )
    return Explanation(
        considered=tuple(reasons.of(offer) for offer in observed.offers),
        replicas=planned.launches,
        wanted=planned.wanted,
        cap=cap,
        assumed=assumed,
        expected=expected(places, assumed, sold),
        with_fallback=_with_fallback(planned.launches, assumed, full, cheapest) if full else None,
        target=spec.availability.target if spec.availability else None,
        cost=cost([launch.offer for launch in planned.launches], spec.services),
        single=None if cheapest is None else (cheapest, cost([cheapest], spec.services)),
        notes=planned.notes,
    )


def _with_fallback(
    launches: Sequence[PlannedLaunch], assumed: Assumption, full: float, on_demand: Offer | None
) -> tuple[float, float] | None:
    """Return availability and cost with stand-ins: each runs while its spot machine is away."""
    if on_demand is None:
        return None
    away = 1.0 - (1.0 - full) * (1.0 - unavailability_of(assumed, spot=True))
    usd = sum(
        offer.usd_per_hour * (1.0 - away) + on_demand.usd_per_hour * away
        if offer.placement.spot
        else offer.usd_per_hour
        for offer in (launch.offer for launch in launches)
    )
    return expected([launch.offer.placement for launch in launches], assumed).correlated, usd


class _Pick(NamedTuple):
    """A launch, with the crowding and the budget at the time it was chosen."""

    launch: PlannedLaunch
    crowd: Counter[str]
    budget: float | None


class _Reasons:
    """Tells why each offer was not chosen."""

    def __init__(
        self, inputs: Inputs, launches: Sequence[PlannedLaunch], cap: float | None
    ) -> None:
        spec, intent, observed, history = inputs
        self._now = observed.now
        self._intent = intent
        self._losses: Mapping[str, list[float]] = history.losses
        self._backing_off = backing_off(history, observed.now)
        self._hazards = hazards(history, observed.now)
        self._scale = Scale(rtt_s=observed.rtt_s)
        self._picks: dict[str, list[_Pick]] = defaultdict(list)
        self._slots: dict[Offer, list[int]] = defaultdict(list)
        taken: list[Placement] = []
        spent = 0.0
        for launch in launches:
            group = group_of(groups_of(spec), launch.slot)
            pick = _Pick(launch, crowding(taken), None if cap is None else cap - spent)
            self._picks[group.name].append(pick)
            self._slots[launch.offer].append(launch.slot)
            taken.append(launch.offer.placement)
            spent += launch.offer.usd_per_hour

    def of(self, offer: Offer) -> Considered:
        """Return an offer with the slots that got it, or why it was not chosen."""
        slots = tuple(self._slots.get(offer, ()))
        location = offer.placement.location
        recent = [t for t in self._losses.get(location, ()) if 0 <= self._now - t < LATELY_S]
        why = None if slots else self._why_not(offer)
        rtt_s = self._scale.latency(offer.placement)
        rate = self._hazards.get(location) if offer.placement.spot else None
        return Considered(offer, slots, why, rtt_s, len(recent), rate)

    def _why_not(self, offer: Offer) -> Reason:
        location = offer.placement.location
        if not is_possible(offer):
            return Reason(Cause.IMPOSSIBLE_PRICE, usd_per_hour=offer.usd_per_hour)
        if self._intent.is_excluded(location):
            return Reason(Cause.EXCLUDED)
        pause = self._backing_off.get(offer.placement.supply) or self._backing_off.get(EVERYWHERE)
        if pause is not None:
            left_s, last = pause.until - self._now, Reason(pause.cause)
            return Reason(Cause.BACKING_OFF, seconds=left_s, count=pause.failures, because=(last,))
        picks = self._picks.get(offer.group, [])
        if not picks:
            return Reason(Cause.OTHER_KIND)
        return max((self._lost_to(offer, pick) for pick in picks), key=itemgetter(0))[1]

    def _lost_to(self, offer: Offer, pick: _Pick) -> tuple[int, Reason]:
        """Return how close an offer came to a chosen one (higher is closer), and why it lost."""
        chosen = pick.launch.offer
        slot = pick.launch.slot
        if offer.placement.spot != chosen.placement.spot:
            kind = "spot" if offer.placement.spot else "on demand"
            return 0, Reason(Cause.OTHER_MARKET, slot=slot, name=kind)
        if pick.budget is not None and offer.usd_per_hour > pick.budget + 1e-9:
            left = max(0.0, pick.budget)
            return 1, Reason(Cause.OVER_BUDGET, slot=slot, limit_usd_per_hour=left)
        both = zip(offer.placement.domains, chosen.placement.domains, strict=True)
        for level, (domain, other) in enumerate(both):
            count = pick.crowd[domain]
            if count > pick.crowd[other]:
                crowded = Reason(Cause.CROWDED, slot=slot, location=domain, count=count)
                return 3 + level, crowded
        return 6, replace(
            self._score(Cause.WORSE_SCORE, offer),
            slot=slot,
            because=(self._score(Cause.CHOSEN, chosen),),
        )

    def _score(self, cause: Cause, offer: Offer) -> Reason:
        return Reason(
            cause,
            location=offer.placement.location,
            seconds=self._scale.latency(offer.placement),
            usd_per_hour=offer.usd_per_hour,
        )
