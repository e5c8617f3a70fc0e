"""Loss rates of spot machines at each location, learned from this pool's history. Pure.

The rate is (PRIOR_LOSSES + losses) / (PRIOR_S + seconds lived there), where older data counts for
less. It is computed as of the last multiple of EVERY_S, including losses since then, so that it
does not depend on when it is asked for.

Not here: the pause after refusals (`backoff`).
"""

import math
from collections.abc import Iterable, Mapping

from fogft.model.reason import Cause
from fogft.planning.observed.history import EventKind, Failure, History, Record

PRIOR_LOSSES = 1.0
PRIOR_S = 4 * 3600.0
HALF_LIFE_S = 24 * 3600.0
EVERY_S = 1800.0
# The cost of a loss, in hours of the lost machine: while its successor boots, another machine
# serves, which is usually more expensive, and one more loss would be an outage.
LOSS_COSTS_H = 1.0
# A refusal counts as this fraction of a loss: where capacity is often short, machines don't last.
REFUSED = 0.1
_DECAY = math.log(2.0) / HALF_LIFE_S


def hazards(history: History, now: float) -> Mapping[str, float]:
    """Return the losses per hour at each location that was asked for spot machines."""
    at, rates = as_of(now), history.rates
    for location, lives in history.lives.items():
        if rates.get(location, (None, 0.0))[0] != at:
            rates[location] = at, _hazard(lives, history.failures.get(location, ()), at)
    return {location: rates[location][1] for location in history.lives}


def as_of(now: float) -> float:
    """Return the time for which rates are computed."""
    return now // EVERY_S * EVERY_S


def _hazard(lives: Iterable[Record], failures: Iterable[Failure], at: float) -> float:
    losses, lived_s = PRIOR_LOSSES, PRIOR_S
    losses += REFUSED * sum(
        _weight(max(at - failure.at, 0.0))
        for failure in failures
        if failure.cause is Cause.CAPACITY
    )
    for record in lives:
        ended = record.closed is not None
        end = min(record.closed_at, at) if ended else at
        if end > record.launched_at:
            lived_s += (_weight(at - end) - _weight(at - record.launched_at)) / _DECAY
        if record.closed is EventKind.GONE:
            losses += _weight(max(at - record.closed_at, 0.0))
    return losses / lived_s * 3600.0


def _weight(age_s: float) -> float:
    return math.exp(-_DECAY * age_s)


def penalty(per_hour: float) -> float:
    """Return the penalty of a loss rate in a score: the logarithm of the added cost."""
    return math.log1p(LOSS_COSTS_H * per_hour)


UNKNOWN = PRIOR_LOSSES / PRIOR_S * 3600.0
