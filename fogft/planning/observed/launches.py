"""Which versions are no longer launched, and the limit of launches per hour. Pure.

A version (`replica_hash`) is given up once a slot has had GIVE_UP_AFTER launches of it that failed
for its own reasons, and none of it was ever ready anywhere; until the file changes or the user asks
again. Spot machines and those on demand are counted apart, so that what restores readiness is not
held up by the limit.
"""

from collections import Counter
from collections.abc import Sequence

from fogft.model.reason import Cause, Reason
from fogft.planning.observed.history import EventKind, History, Record

GIVE_UP_AFTER = 2
LAUNCHES_AN_HOUR = 12
HOUR_S = 3600.0


def given_up(history: History, version: str, since: float) -> Reason | None:
    """Return why a version is no longer launched; None while it is.

    What was launched before `since` does not count: the user asked for it again.
    """
    if version in history.ready_versions:
        return None
    fruitless = history.fruitless.get(version, ())
    failed = [record for record in fruitless if record.launched_at >= since]
    if max(Counter(record.slot for record in failed).values(), default=0) < GIVE_UP_AFTER:
        return None
    return Reason(Cause.NEVER_READY, count=len(failed), because=(failed[-1].fault,))


def within_an_hour(history: History, now: float, *, on_demand: bool) -> Sequence[Record]:
    """Return the launches of one market within the last hour that got a machine."""
    return [
        record
        for record in history.launches[on_demand]
        if 0 <= now - record.launched_at < HOUR_S and not _was_refused(record)
    ]


def _was_refused(record: Record) -> bool:
    """Whether a launch cost nothing: at once, or after the cloud had looked for a place."""
    late = record.failed and record.fault.cause in (Cause.CAPACITY, Cause.QUOTA, Cause.CREDENTIALS)
    return late or record.closed is EventKind.REFUSED


def next_change(history: History, now: float) -> float:
    """Return when a launch is an hour old next; infinity for never."""
    ends = [record.launched_at + HOUR_S for both in history.launches.values() for record in both]
    return min([at for at in ends if at > now], default=float("inf"))
