"""Decide how many replicas are wanted now, and up to what price. Pure.

The number for an availability target is that of a pool placed from scratch over all offers: it
depends on the offers alone, not on what runs, so it does not change with every preemption.

Not here: which launches are missing (`planner`), the arithmetic (`availability`).
"""

from typing import NamedTuple

from fogft.model.choices import MAX_REPLICAS, AvailabilitySpec
from fogft.model.groups import Group, groups_of, shares
from fogft.model.intent import Intent
from fogft.model.reason import Cause, Reason, because
from fogft.model.replica import Observed, Offer, Placement
from fogft.model.schedule import window_at, wish
from fogft.model.spec import PoolSpec
from fogft.planning.availability import expected, full_together, replicas_needed, unavailability_of
from fogft.planning.listing import Listing, Scale, catalogue
from fogft.planning.observed.history import History
from fogft.planning.placement import Market

# If a target is out of reach, the downtime may exceed the lowest possible one by this factor.
MUCH_THE_SAME = 1.1


class Inputs(NamedTuple):
    """Everything that a plan depends on."""

    spec: PoolSpec
    intent: Intent
    observed: Observed
    history: History


class Size(NamedTuple):
    """The wanted number of replicas, and the cap."""

    groups: tuple[Group, ...]  # in the order of their slots
    counts: tuple[int, ...]  # replicas of each
    max_usd_per_hour: float | None  # the cap that holds now; None for none
    notes: tuple[Reason, ...] = ()  # what may surprise the user

    @property
    def total(self) -> int:
        """The wanted number of replicas in all groups."""
        return sum(self.counts)


def size(inputs: Inputs, running: int = 0) -> Size:
    """Return the wanted number of replicas of each group, and the cap.

    `running` is the current number: near the cap, or while nothing is offered, the number for a
    target does not fall below it.
    """
    spec, intent, observed, _ = inputs
    groups = groups_of(spec)
    now = wish(spec, observed.wall_clock)
    window = spec.schedule and not now.ahead and window_at(spec.schedule, observed.wall_clock)
    notes = [Reason(Cause.SCHEDULED_AHEAD)] if now.ahead else []
    cap = observed.below(now.max_usd_per_hour)
    total = now.replicas
    if intent.stopping or intent.is_scaled(spec):
        total = intent.wanted(spec, observed.wall_clock)
    elif spec.availability and total == spec.replicas and not (window and window.replicas):
        total, unmet = _for_target(inputs, spec.availability, cap, running)
        notes += because(unmet)
    return Size(groups, shares(groups, total), cap, tuple(notes))


def cap_usd(spec: PoolSpec, observed: Observed) -> float | None:
    """Return what is left of the current cap after gateway and standbys; None for no cap."""
    return observed.below(wish(spec, observed.wall_clock).max_usd_per_hour)


def spot_sold(inputs: Inputs) -> list[Placement]:
    """Return a placement in each location with spot offers; empty if on-demand stands in."""
    groups = groups_of(inputs.spec)
    if any(group.on_demand.fallback for group in groups):
        return []
    rows = (row for group in groups for row in _listing(inputs, group, True).rows)
    return list({row.location: row.offer.placement for row in rows}.values())


def _listing(inputs: Inputs, group: Group, spot: bool | None) -> Listing:
    spec, intent, observed, _ = inputs
    scale = Scale(spec.placement.latency_weight, observed.rtt_s, spec.name)
    return catalogue(observed.offers).listing(group.name, spot, intent.excluded, scale)


def _layout(inputs: Inputs, cap: float | None) -> list[Placement]:
    """Return the placements of the largest pool started from scratch, as far as offers allow."""
    chosen: list[Offer] = []
    groups = groups_of(inputs.spec)
    for group, count in zip(groups, shares(groups, MAX_REPLICAS), strict=True):
        base, fallback = group.on_demand.base, group.on_demand.fallback
        kinds = (True, False) if fallback else (True,) if base else (None,)
        markets = {spot: Market(_listing(inputs, group, spot)) for spot in (False, *kinds)}
        for mine in range(count):
            budget = None if cap is None else cap - sum(o.usd_per_hour for o in chosen)
            places = [offer.placement for offer in chosen]
            for spot in (False,) if mine < base else kinds:
                offer = markets[spot].choose(places, budget_usd_per_hour=budget).offer
                if offer is not None:
                    chosen.append(offer)
                    break
            else:
                break
    return [offer.placement for offer in chosen]


def _for_target(
    inputs: Inputs, asked: AvailabilitySpec, cap: float | None, running: int
) -> tuple[int, Reason | None]:
    """Return the fewest replicas that reach the target, or that come close to the best possible.

    The reason says why the target cannot be reached; None if it can.
    """
    least = inputs.spec.replicas
    if not inputs.observed.offers:
        one = 1.0 - unavailability_of(asked, spot=True)
        needed = replicas_needed(one, asked.target, limit=10_000)
        return min(MAX_REPLICAS, max(least, running, needed)), None
    laid = _layout(inputs, cap)
    down: list[float] = []
    sold = spot_sold(inputs)
    for count in range(1, len(laid) + 1):
        down.append(1.0 - expected(laid[:count], asked, sold).correlated)
        if down[-1] <= 1.0 - asked.target + 1e-12 and count >= least:
            return count, None
    enough = next((n for n, share in enumerate(down, 1) if share <= MUCH_THE_SAME * down[-1]), 0)
    # Not below what runs: near the cap, fluctuating prices would make the number fluctuate.
    count = max(1, least, enough, min(running, len(laid)))
    most = Reason(Cause.MOST_REPLICAS, count=MAX_REPLICAS)
    why = Reason(Cause.OVER_CAP) if len(laid) < MAX_REPLICAS else most
    full = full_together(sold, asked)
    if full > 1.0 - asked.target:
        why = Reason(Cause.FULL_TOGETHER, share=full)
    note = Reason(
        Cause.TARGET_UNMET,
        count=enough,
        share=1.0 - down[enough - 1] if down else 0.0,
        target=asked.target,
        because=(why,),
    )
    return count, note
