"""Which versions are no longer launched, and the limit of launches per hour. Pure.

A version (`replica_hash`) is given up once GIVE_UP_AFTER of its launches in one slot failed by its
own fault and no replica of it was ever ready; until the file changes or the user asks again. Spot
and on-demand launches are counted separately, so that the limit does not delay a stand-in that
restores readiness.
"""

from collections import Counter

from fogft.model.reason import Cause, Reason
from fogft.planning.observed.history import EventKind, History, Record

GIVE_UP_AFTER = 2
LAUNCHES_AN_HOUR = 12
HOUR_S = 3600.0


def given_up(history: History, version: str, since: float) -> Reason | None:
    """Return why a version is no longer launched; None while it is.

    Launches before `since` do not count: the user asked for the version again.
    """
    if version in history.ready_versions:
        return None
    fruitless = history.fruitless.get(version, ())
    failed = [record for record in fruitless if record.launched_at >= since]
    if max(Counter(record.slot for record in failed).values(), default=0) < GIVE_UP_AFTER:
        return None
    return Reason(Cause.NEVER_READY, count=len(failed), because=(failed[-1].fault,))


def within_an_hour(history: History, now: float, since: float, *, on_demand: bool) -> list[Record]:
    """Return the launches of one market since then, within the last hour, that got a machine."""
    return [
        record
        for record in history.launches[on_demand]
        if since <= record.launched_at <= now
        and now - record.launched_at < HOUR_S
        and not _was_refused(record)
    ]


def _was_refused(record: Record) -> bool:
    """Whether a launch was refused at no cost: at once, or after the cloud looked for room."""
    late = record.failed and record.fault.cause in (Cause.CAPACITY, Cause.QUOTA, Cause.CREDENTIALS)
    return late or record.closed is EventKind.REFUSED


def next_change(history: History, now: float) -> float:
    """Return when the next launch becomes an hour old; infinity for never."""
    ends = [record.launched_at + HOUR_S for both in history.launches.values() for record in both]
    return min([at for at in ends if at > now], default=float("inf"))
