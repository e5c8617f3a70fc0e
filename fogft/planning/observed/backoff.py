"""How long a location is avoided after failures. Pure. The rule: docs/design/planner.md.

A location's spot machines and its on-demand machines are two supplies, and each backs off on its
own. Failures caused by the pool file count against `EVERYWHERE`, so that a broken file is not tried
in one location after the other. NO_ROOM_S is long enough to try all locations before the first is
asked again. Events in the future, left by a clock that was set back, are ignored.
"""

from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
from typing import NamedTuple

from fogft.model.reason import Cause
from fogft.planning.observed.history import OWN_FAULTS, Failure, History

BASE_S = 5.0
NO_ROOM_S = 120.0
LIMIT_S = 600.0
FORGIVE_S = 3600.0
EVERYWHERE = "*"
NEVER = float("inf")
EAGER_S = 60.0
_AT = itemgetter(0)


class Backoff(NamedTuple):
    """The pause of a supply that must not be tried yet."""

    until: float  # when it may be tried again, in seconds since the epoch
    failures: int  # how many in a row
    cause: Cause  # of the last failure
    since: float = 0.0  # of the last failure, in seconds since the epoch


class _Supply(NamedTuple):
    """The failures of a supply within FORGIVE_S, in order of time."""

    lately: Sequence[Failure]  # all of them
    bad: Sequence[Failure]  # those since it last proved itself


def backing_off(history: History, now: float) -> Mapping[str, Backoff]:
    """Return the supplies (`Placement.supply`) that must not be tried now, with the reason.

    The key `EVERYWHERE` means that nothing may be launched at all.
    """
    supplies = _supplies(history, now)
    pauses, everywhere = _pauses(supplies, now), _everywhere(history, supplies, now)
    return pauses if everywhere is None else {**pauses, EVERYWHERE: everywhere}


def recently_failed(history: History, now: float) -> Mapping[str, Backoff]:
    """Return the supplies that failed within FORGIVE_S and have not proved themselves since."""
    found = _supplies(history, now).items()
    last = {supply: one.bad[-1] for supply, one in found if one.bad}
    return {
        supply: Backoff(failure.at + FORGIVE_S, 1, failure.cause, since=failure.at)
        for supply, failure in last.items()
    }


def _supplies(history: History, now: float) -> Mapping[str, _Supply]:
    """Return the supplies with a failure that is not forgiven."""
    found = {}
    for supply, failures in history.failures.items():
        if failures[-1].at <= now - FORGIVE_S:  # true of most; there may be thousands
            continue
        first = bisect_right(failures, now - FORGIVE_S, key=_AT)
        lately = failures[first : bisect_right(failures, now, key=_AT)]
        if lately:
            proven_at = history.proven_at(supply)
            found[supply] = _Supply(lately, [f for f in lately if f.at > proven_at])
    return found


def _pauses(supplies: Mapping[str, _Supply], now: float) -> dict[str, Backoff]:
    """Return the backoff of each supply, without failures caused by the pool file."""
    found = {
        supply: backoff([f for f in one.bad if f.cause not in OWN_FAULTS], now)
        for supply, one in supplies.items()
    }
    return {supply: pause for supply, pause in found.items() if pause is not None}


def _everywhere(history: History, supplies: Mapping[str, _Supply], now: float) -> Backoff | None:
    setup = [f for one in supplies.values() for f in one.lately if f.cause in OWN_FAULTS]
    if not setup:
        return None
    proven_at = max(map(history.proven_at, history.failures))
    return backoff(sorted([f for f in setup if f.at > proven_at], key=_AT), now)


def backing_off_longest(backing_off: Iterable[tuple[str, Backoff]], now: float) -> str | None:
    """Return the supply to try although all are backing off; None to wait.

    Only one that had no capacity is tried: retrying fixes neither a quota nor a failing launch.
    """
    known = list(backing_off)
    if any(now - pause.since < EAGER_S for _, pause in known):
        return None
    full = [(pause.since, supply) for supply, pause in known if pause.cause is Cause.CAPACITY]
    return min(full, default=(0.0, None))[1]


def backoff(recent: Sequence[Failure], now: float) -> Backoff | None:
    """Return the backoff after failures that are not forgiven, in order of time; None if over."""
    if not recent:
        return None
    last = recent[-1]
    # A short pause does not help if the account's quota is used up.
    until = last.at + (LIMIT_S if last.cause is Cause.QUOTA else backoff_s(len(recent), last.cause))
    return None if now >= until else Backoff(until, len(recent), last.cause, since=last.at)


def backoff_s(failures: int, cause: Cause | None = None) -> float:
    """Return how long a supply backs off after this many failures in a row, in seconds."""
    base_s = NO_ROOM_S if cause is Cause.CAPACITY else BASE_S
    return min(base_s * 2.0 ** min(max(failures, 1) - 1, 16), LIMIT_S)


def lost_lately(history: History, now: float) -> Mapping[str, float]:
    """Return the locations that lost replicas within NO_ROOM_S, and until when that counts.

    They are used only when no other is left: they are unlikely to have capacity again.
    """
    found = {}
    for location, losses in history.losses.items():
        lately = losses[bisect_right(losses, now - NO_ROOM_S) : bisect_right(losses, now)]
        if lately:
            found[location] = lately[-1] + NO_ROOM_S
    return found


def next_change(history: History, now: float, *, waits: bool, restless: bool) -> float:
    """Return when another location may be chosen even without new events; infinity for never.

    `waits` and `restless`: see `Plan`.
    """
    supplies = _supplies(history, now)
    everywhere = _everywhere(history, supplies, now)
    times: list[float] = []
    if everywhere is not None:
        lately = [f for one in supplies.values() for f in one.lately]
        times += [everywhere.until, *_shortened(lately, everywhere)]
    if waits:
        pauses = _pauses(supplies, now)
        for supply, pause in pauses.items():
            times += [pause.until, *_shortened(supplies[supply].lately, pause)]
        since = [pause.since for pause in (*pauses.values(), *filter(None, [everywhere]))]
        times.append(max(since, default=-NEVER) + EAGER_S)
    if restless:
        times += [one.bad[-1].at + FORGIVE_S for one in supplies.values() if one.bad]
    if waits or restless:  # a stand-in does not return to where one was just lost
        times += lost_lately(history, now).values()
    return min([at for at in times if at > now], default=NEVER)


def _shortened(lately: Iterable[Failure], pause: Backoff) -> Sequence[float]:
    """Return when failures are forgiven, if that may end a pause early; empty if not."""
    forgiven = [f.at + FORGIVE_S for f in lately if f.at + FORGIVE_S < pause.until]
    if backoff_s(pause.failures - len(forgiven), pause.cause) < pause.until - pause.since:
        return forgiven
    return ()
