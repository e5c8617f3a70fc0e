"""Move a replica to where it would be launched today, if that is much better. Pure.

Only a pool that is whole and quiet moves anything, one replica at a time, the new one first.
A replica moves when

* it is on demand and should be spot, or the other way round; or
* its new place would leave the pool better spread over clouds, regions or zones; or
* the spread stays as it is, and its score falls by `gain`.

It has then been ready for `stay_s`, and the new place is neither at rest nor avoided, nor has it
refused within an hour. To move back, the scores must swing by twice the gain: so while prices
waver within it nobody returns to where he was, and with steady offers every move lowers the
crowding or the sum of the scores, so that moves come to an end.

Owns: who moves, and why.
Not here: carrying it out, which is a replacement like any other (`needs`, `buying`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

from fogft.model.reason import Cause, Reason
from fogft.model.replica import ReplicaId
from fogft.model.scoring import gain
from fogft.planning.buying import Buyer
from fogft.planning.endings import Census, Standing
from fogft.planning.listing import catalogue
from fogft.planning.needs import home
from fogft.planning.observed.health import Health
from fogft.planning.placement import Choice, Crowd, crowding, domains


def is_quiet(census: Census, health: Health) -> bool:
    """Whether nothing else is to be done: all are good and serve, and can be heard."""
    busy = census.replaced or census.lost or census.failed or census.aborted or census.ending
    heard = health.links_known and not health.uplink_suspected
    return not busy and heard and all(s.judged.serving for s in census.good)


@dataclass(frozen=True)
class Move:
    """A replica that should be elsewhere, and why.

    Attributes:
        urgency: The lowest goes first.
    """

    standing: Standing
    why: Reason
    urgency: tuple[float, ...]


def restless(buyer: Buyer) -> frozenset[ReplicaId]:
    """Return who would move if no location rested or were avoided, and all had stayed.

    Nobody else moves before something happens, however long that takes: what a location that
    rests no longer sells has been in question already. Neither time nor events come into it, so
    the last answer is kept: a quiet pool asks the same again and again.
    """
    spec, observed = buyer.spec, buyer.observed
    if spec.migration is None:
        return frozenset()
    machines = [standing.judged.machine for standing in buyer.census.good]
    question = (
        buyer.groups,
        machines,
        buyer.budget,
        {**observed.rtt_s},
        buyer.intent.excluded,
        buyer.hazards,
    )
    offers, asked, answer = spec.derived.get("restless", ((), None, frozenset()))
    if offers is not observed.offers or asked != question:
        answer = frozenset(s.id for s in buyer.census.good if _would_move(buyer, s))
        spec.derived["restless"] = observed.offers, question, answer
    found: frozenset[ReplicaId] = answer
    return found


def _would_move(buyer: Buyer, standing: Standing) -> bool:
    kind = buyer.kind(home(buyer.groups, standing.slot), standing)
    market = buyer.whole_market(home(buyer.groups, standing.slot), kind)
    count = crowding(buyer.places(standing))
    choice = market.choose(count, budget_usd_per_hour=buyer.budget)
    return _is_better(buyer, standing, choice, count) is not None


def mover(buyer: Buyer, now: float, restless: Collection[ReplicaId]) -> Move | None:
    """Return the replica that should move; None when all are well where they are.

    The pool is quiet. The one that gains most goes first.
    """
    found = _moves(buyer, now, restless)
    return min(found, key=lambda move: (move.urgency, move.standing.id), default=None)


def _moves(buyer: Buyer, now: float, restless: Collection[ReplicaId]) -> Iterator[Move]:
    """Yield those that would be better off elsewhere, with how much."""
    rules = buyer.spec.migration
    if rules is None:
        return
    for standing in buyer.census.good:
        if standing.id not in restless or not _stayed(standing, rules.stay_s, now):
            continue
        count = crowding(buyer.places(standing))
        choice = _best(buyer, standing, count, at_leisure=True)
        move = _is_better(buyer, standing, choice, count)
        if move is not None:
            yield move


def _is_better(buyer: Buyer, standing: Standing, choice: Choice, count: Crowd) -> Move | None:
    """Return the move to a place if that is so much better."""
    rules, placement = buyer.spec.migration, standing.judged.machine.placement
    offer, (avoided, *there) = choice.offer, choice.rank
    if rules is None or offer is None or avoided or offer.placement == placement:
        return None
    kind = buyer.kind(home(buyer.groups, standing.slot), standing)
    if kind is not None and kind != placement.spot:
        cause = Cause.SPOT_AGAIN if kind else Cause.ON_DEMAND_AGAIN
        return Move(standing, Reason(cause, location=offer.placement.location), (-1.0,))
    here = [count[domain] for domain in domains(placement)]
    if there < here:
        why = Reason(Cause.BETTER_SPREAD, location=offer.placement.location)
        return Move(standing, why, (0.0, *there))
    better = gain(_score(buyer, standing), buyer.score(offer.placement, offer.usd_per_hour))
    if there == here and better >= rules.gain:
        why = Reason(Cause.BETTER_SCORE, location=offer.placement.location, share=better)
        return Move(standing, why, (1.0, -better))
    return None


def _best(buyer: Buyer, standing: Standing, count: Crowd, *, at_leisure: bool = False) -> Choice:
    group = home(buyer.groups, standing.slot)
    market = buyer.market(group, buyer.kind(group, standing), at_leisure=at_leisure)
    return market.choose(count, budget_usd_per_hour=buyer.budget)


def _score(buyer: Buyer, standing: Standing) -> float:
    """Return the score of where it is, at today's price there if that is known."""
    machine = standing.judged.machine
    today = catalogue(buyer.observed.offers).cheapest
    price = today.get(machine.placement, machine.usd_per_hour)
    return buyer.score(machine.placement, price)


def _stayed(standing: Standing, stay_s: float, now: float) -> bool:
    record = standing.record
    if record is None or record.first_ready_at is None:
        return False
    return now - record.first_ready_at >= stay_s
