"""When a pool shuts down because of `max_hours`. Pure.

The end is not stored: every tick computes it again, so no manager can forget it, and a file with a
larger `max_hours` gives more time to a pool that still runs.
"""

from dataclasses import replace

from fogft.model.intent import Intent
from fogft.model.reason import Cause, Reason
from fogft.model.spec import PoolSpec
from fogft.planning.observed.history import History

HOUR_S = 3600.0
SOON_S = 600.0


def begun_at(intent: Intent, created_at: float, history: History) -> float:
    """Return when `max_hours` began, by the current clock, which may have been set since."""
    return history.by_clock(intent.began_at or created_at)


def ends_at(spec: PoolSpec, begun_at: float) -> float | None:
    """Return when `max_hours` ends a pool, in seconds since the epoch; None for never."""
    return None if spec.max_hours is None else begun_at + spec.max_hours * HOUR_S


def unmanaged_s(spec: PoolSpec, begun_at: float, now: float) -> float:
    """Return how long replicas may serve without a manager from now on, in seconds."""
    lasts_s, end = spec.unmanaged_max_hours * HOUR_S, ends_at(spec, begun_at)
    return lasts_s if end is None else max(0.0, min(lasts_s, end - now))


def is_over(spec: PoolSpec, begun_at: float, now: float) -> bool:
    """Whether a pool's `max_hours` have passed."""
    end = ends_at(spec, begun_at)
    return end is not None and now >= end


def revived(spec: PoolSpec, intent: Intent, begun_at: float, now: float) -> Intent:
    """Return the intent after an `up`: `max_hours` start again if they have passed."""
    return replace(intent, began_at=now) if is_over(spec, begun_at, now) else intent


def notes(spec: PoolSpec, begun_at: float, now: float) -> list[Reason]:
    """Return a note if `max_hours` end soon or have passed; nothing otherwise."""
    end = ends_at(spec, begun_at)
    if end is None or now < end - SOON_S:
        return []
    if now < end:
        return [Reason(Cause.ENDS_SOON, seconds=end - now)]
    return [Reason(Cause.MAX_HOURS, seconds=end - begun_at)]
