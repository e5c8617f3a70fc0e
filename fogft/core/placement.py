"""Choose where the next replica goes. Pure and deterministic.

Spread first, price second: replicas in one zone are preempted together, and a cloud or a
region fails as a whole, so the offer whose cloud, then region, then zone holds the fewest
of our replicas wins; among those the cheapest; among those the first by name.

Owns: the order among offers and the reason when none is left.
Not here: how long a location rests (`quarantine`) and how many are needed (`planner`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from fogft.core.model import Offer, Placement
from fogft.core.quarantine import EVERYWHERE, Backoff

EPSILON_USD = 1e-9


@dataclass(frozen=True)
class Choice:
    """An offer, or none and why not, in words."""

    offer: Offer | None
    why_not: str = ""


def domains(placement: Placement) -> tuple[str, str, str]:
    """Return the failure domains that a placement lies in, the widest first."""
    region = f"{placement.cloud}/{placement.region}"
    return placement.cloud, region, placement.location


def crowding(taken: Iterable[Placement]) -> Counter[str]:
    """Count replicas in each failure domain."""
    return Counter(domain for placement in taken for domain in domains(placement))


def choose(
    offers: Sequence[Offer],
    *,
    taken: Collection[Placement],
    excluded: Collection[str] = (),
    resting: Mapping[str, Backoff] | None = None,
    avoid: Collection[str] = (),
    budget_usd_per_hour: float | None = None,
) -> Choice:
    """Choose among offers, given where our other replicas are.

    Args:
        offers: What can be bought, in any order.
        taken: Where the replicas that stay are.
        excluded: Locations (``cloud``, ``cloud/region`` or all three) that the user ruled out.
        resting: Locations in backoff.
        avoid: Locations to use only when no other is left: one was just lost there.
        budget_usd_per_hour: The most that the new machine may cost; None for no limit.
    """
    resting = resting or {}
    if EVERYWHERE in resting:
        rest = resting[EVERYWHERE]
        return Choice(None, f"waiting after {rest.failures} failed launches ({rest.cause})")
    if not offers:
        return Choice(None, "nothing is offered for these resources now")
    allowed = [o for o in offers if not any(o.placement.within(place) for place in excluded)]
    if not allowed:
        return Choice(None, "every offered location is excluded")
    rested = [o for o in allowed if o.placement.location not in resting]
    if not rested:
        places = sorted({o.placement.location for o in allowed})
        causes = ", ".join(f"`{place}`: {resting[place].cause}" for place in places)
        return Choice(None, f"every location rests after failures ({causes})")
    affordable = [
        o
        for o in rested
        if budget_usd_per_hour is None or o.usd_per_hour <= budget_usd_per_hour + EPSILON_USD
    ]
    if not affordable:
        cheapest = min(o.usd_per_hour for o in rested)
        return Choice(
            None,
            f"the cheapest offer is ${cheapest:.3f}/h and `max_usd_per_hour` "
            f"leaves ${max(budget_usd_per_hour or 0.0, 0.0):.3f}/h",
        )
    count = crowding(taken)
    avoided = frozenset(avoid)

    def rank(offer: Offer) -> tuple[bool, int, int, int, float, Placement]:
        cloud, region, zone = domains(offer.placement)
        return (
            zone in avoided,
            count[cloud],
            count[region],
            count[zone],
            offer.usd_per_hour,
            offer.placement,
        )

    return Choice(min(affordable, key=rank))
