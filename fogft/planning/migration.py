"""Move a replica to the location where it would be launched today, if that is much better. Pure.

Only a pool that is complete and quiet moves replicas, one at a time, new before old, for the
reasons in docs/design/planner.md. To move back, prices must swing by twice `GAIN`: so with steady
offers every move lowers the crowding or the sum of the scores, and moves come to an end.

Not here: carrying out a move, which is a replacement like any other (`needs`, `buying`).
"""

import math
from collections.abc import Collection
from dataclasses import dataclass

from fogft.model.groups import group_of
from fogft.model.reason import Cause, Reason
from fogft.model.replica import ReplicaId
from fogft.planning.buying import Buyer
from fogft.planning.classification import Classification
from fogft.planning.observed.hazard import UNKNOWN
from fogft.planning.observed.health import Assessment, Health
from fogft.planning.placement import crowding

GAIN = 0.3
STAY_S = 600.0  # a replica that has just become ready stays for this long


def is_quiet(machines: Classification, health: Health) -> bool:
    """Whether nothing else is pending: all replicas are healthy, serve and can be reached."""
    busy = (
        machines.replaced or machines.lost or machines.failed or machines.aborted or machines.ending
    )
    heard = health.links_known and not health.uplink_suspected
    return not busy and heard and all(s.serving for s in machines.good)


@dataclass(frozen=True)
class Move:
    """A replica that should be elsewhere, and why."""

    replica: Assessment
    why: Reason
    urgency: tuple[float, ...]  # the lowest goes first


def restless(buyer: Buyer) -> frozenset[ReplicaId]:
    """Return the replicas that would move if no location backed off and none had moved lately.

    However much time passes, no other replica moves until an input changes: offers in backoff are
    considered here, too. Time and events do not matter, so the last answer is cached: a quiet pool
    asks the same question at every tick.
    """
    spec, observed = buyer.spec, buyer.observed
    if not spec.migration:
        return frozenset()
    running = [replica.machine for replica in buyer.machines.good]
    question = (
        buyer.groups,
        running,
        buyer.budget,
        {**observed.rtt_s},
        buyer.intent.excluded,
        buyer.hazards,
    )
    offers, asked, answer = spec.derived.get("restless", ((), None, frozenset()))
    if offers is not observed.offers or asked != question:
        good = buyer.machines.good
        answer = frozenset(s.id for s in good if _move(buyer, s, at_most=True))
        spec.derived["restless"] = observed.offers, question, answer
    found: frozenset[ReplicaId] = answer
    return found


def mover(buyer: Buyer, now: float, restless: Collection[ReplicaId]) -> Move | None:
    """Return the move of a quiet pool's replica that gains most; None if none should move."""
    found = [
        _move(buyer, replica, at_most=False)
        for replica in buyer.machines.good
        if replica.id in restless and replica.was_ready_for(STAY_S, now)
    ]
    moves = [move for move in found if move is not None]
    return min(moves, key=lambda move: (move.urgency, move.replica.id), default=None)


def _move(buyer: Buyer, replica: Assessment, *, at_most: bool) -> Move | None:
    """Return the move to the best location if the gain is large enough.

    With `at_most`: could this move, or a lesser one, be worth it if no location backed off?
    """
    group, placement = group_of(buyer.groups, replica.slot), replica.placement
    kind = buyer.kind(group, replica)
    market = (
        buyer.whole_market(group, kind) if at_most else buyer.market(group, kind, at_leisure=True)
    )
    count = crowding(buyer.places(replica))
    choice = market.choose(count, budget_usd_per_hour=buyer.budget)
    offer, (avoided, *there) = choice.offer, choice.rank
    if offer is None or avoided or offer.placement == placement:
        return None
    if kind is not None and kind != placement.spot:
        cause = Cause.SPOT_AGAIN if kind else Cause.ON_DEMAND_AGAIN
        return Move(replica, Reason(cause, location=offer.placement.location), (-1.0,))
    here = [count[domain] for domain in placement.domains]
    losses, losses_there = (buyer.losses_per_hour(p) for p in (placement, offer.placement))
    if there < here and (at_most or losses_there <= losses + UNKNOWN):
        why = Reason(Cause.BETTER_SPREAD, location=offer.placement.location)
        return Move(replica, why, (0.0, *there))
    score = buyer.score(placement, buyer.price(replica))
    better = 1.0 - math.exp(buyer.score(offer.placement, offer.usd_per_hour) - score)
    if there == here and better >= GAIN:
        why = Reason(Cause.BETTER_SCORE, location=offer.placement.location, share=better)
        return Move(replica, why, (1.0, -better))
    return None
