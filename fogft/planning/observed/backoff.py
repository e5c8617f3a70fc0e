"""How long a location is left alone after failures. Pure.

A location sells spot machines and on-demand ones; each supply backs off by itself. Failures are
refused launches (no capacity, no quota), launches that failed, and replicas that died young. After
n failures in a row a supply is not tried for

    min(BASE_S * 2 ** (n - 1), LIMIT_S)

seconds from the last one; NO_ROOM_S in place of BASE_S where it had no room, so that a round over
all locations ends before the first is asked again. A replica that becomes ready there, or
FORGIVE_S without a failure, ends it. A failed `setup`, or a service that is not ready in time, is
the pool file's fault, not the location's: it counts against `EVERYWHERE`, so that a broken file is
not tried in one location after the other.

While all supplies back off, the one whose last failure is oldest is tried, one try in EAGER_S. A
replica that could move, but need not, asks no location that refused within FORGIVE_S and has had
none ready since. Events from the future, left by a clock that was set back, count for nothing.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
from typing import NamedTuple

from fogft.model.reason import Cause
from fogft.planning.observed.expiring import Expiring
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
    """A supply that must not be tried yet.

    Attributes:
        since: Of the last failure, in seconds since the epoch.
        until: From then on it may be tried again.
        failures: How many in a row.
        cause: Of the last one.
    """

    until: float
    failures: int
    cause: Cause
    since: float = 0.0


class _Outlook(NamedTuple):
    """What a supply's failures and proofs say of it.

    Attributes:
        pause: Whatever was the pool file's fault is left out.
        backoff_changes: When it ends or gets shorter; infinity where there is none.
        setup: The failures that are the pool file's fault, those of late among them.
        recent_failure: It has failed of late, and not proved itself since.
    """

    pause: Backoff | None
    backoff_changes: float
    setup: Sequence[Failure]
    recent_failure: Backoff | None


class _Supplies(NamedTuple):
    """The outlooks of all supplies together."""

    backing_off: Mapping[str, Backoff]
    backoff_changes: float
    setup: Sequence[Failure]
    recently_failed: Mapping[str, Backoff]


def backing_off(history: History, now: float) -> Mapping[str, Backoff]:
    """Return the supplies (`Placement.supply`) that must not be tried now, with the reason.

    The key `EVERYWHERE` means that nothing may be launched at all.
    """
    supplies = history.of_places(history.failures, _outlook, _summed_up, now)
    everywhere = _everywhere(history, supplies.setup, now) if supplies.setup else None
    return (
        supplies.backing_off
        if everywhere is None
        else {**supplies.backing_off, EVERYWHERE: everywhere}
    )


def recently_failed(history: History, now: float) -> Mapping[str, Backoff]:
    """Return the supplies that failed within FORGIVE_S and have not proved themselves since.

    Only the last failure counts.
    """
    return history.of_places(history.failures, _outlook, _summed_up, now).recently_failed


def _outlook(history: History, supply: str, now: float) -> Expiring[_Outlook | None]:
    lately, until = _lately(history.failures[supply], now)
    if not lately:
        return Expiring(None, until)
    proven_at = history.proven_at(supply)
    bad = lately if lately[0].at > proven_at else [f for f in lately if f.at > proven_at]
    setup = [f for f in lately if f.cause in OWN_FAULTS]
    pause = _backoff([f for f in bad if f.cause not in OWN_FAULTS] if setup else bad, now)
    backoff_changes = NEVER if pause is None else min([pause.until, *_shortened(lately, pause)])
    recent_failure = None
    if bad:
        last = bad[-1]
        recent_failure = Backoff(last.at + FORGIVE_S, 1, last.cause, since=last.at)
    if history.failures[supply][-1].at <= now:  # to forgive the others changes a pause at most
        until = lately[-1].at + FORGIVE_S
    until = min(until, backoff_changes)
    return Expiring(_Outlook(pause, backoff_changes, setup, recent_failure), until)


def _summed_up(outlooks: Mapping[str, _Outlook]) -> _Supplies:
    backing_off, recently_failed = {}, {}
    setup: list[Failure] = []
    change = NEVER
    for supply, one in outlooks.items():
        if one.pause is not None:
            backing_off[supply] = one.pause
            change = min(change, one.backoff_changes)
        if one.recent_failure is not None:
            recently_failed[supply] = one.recent_failure
        setup += one.setup
    return _Supplies(backing_off, change, setup, recently_failed)


def _everywhere(history: History, setup: Sequence[Failure], now: float) -> Backoff | None:
    proven_at = max(history.proven_at(place) for place in history.failures)
    return backoff([f for f in setup if f.at > proven_at], now)


def backing_off_longest(backing_off: Iterable[tuple[str, Backoff]], now: float) -> str | None:
    """Return the supply to try although it backs off, as all do; None to wait.

    Only what had no room is tried: a full account or a launch that fails does not get better by it.
    """
    known = list(backing_off)
    if any(now - pause.since < EAGER_S for _, pause in known):
        return None
    full = [(pause.since, supply) for supply, pause in known if pause.cause is Cause.CAPACITY]
    return min(full, default=(0.0, None))[1]


def _lately(failures: Sequence[Failure], now: float) -> tuple[Sequence[Failure], float]:
    """Return those that still count, of failures in order of time, and until when it is those."""
    if not failures or failures[-1].at <= now - FORGIVE_S:
        return (), NEVER
    first = end = len(failures)
    until = NEVER
    while end and failures[end - 1].at > now:
        end -= 1
        until = failures[end].at
    while first and failures[first - 1].at > now - FORGIVE_S:
        first -= 1
    if first < end:
        until = min(until, failures[first].at + FORGIVE_S)
    return failures[first:end], until


def backoff(failures: list[Failure], now: float) -> Backoff | None:
    """Return the pause that a run of failures earns, or None when it is over."""
    return _backoff(sorted([f for f in failures if 0 <= now - f.at < FORGIVE_S], key=_AT), now)


def _backoff(recent: Sequence[Failure], now: float) -> Backoff | None:
    """Return the pause that failures earn, of which none is forgiven, in order of time."""
    if not recent:
        return None
    last = recent[-1]
    # Waiting a little does not help where the account is full.
    until = last.at + (LIMIT_S if last.cause is Cause.QUOTA else backoff_s(len(recent), last.cause))
    return None if now >= until else Backoff(until, len(recent), last.cause, since=last.at)


def backoff_s(failures: int, cause: Cause | None = None) -> float:
    """Return how long so many failures in a row make a supply back off, in seconds."""
    base_s = NO_ROOM_S if cause is Cause.CAPACITY else BASE_S
    return min(base_s * 2.0 ** min(max(failures, 1) - 1, 16), LIMIT_S)


def lost_lately(history: History, now: float) -> Mapping[str, float]:
    """Return where a replica was lost within NO_ROOM_S, and until when that counts.

    Such a location is used only when no other is left: it has hardly room again.
    """
    found = {}
    for location, losses in history.losses.items():
        lately = losses[bisect_right(losses, now - NO_ROOM_S) : bisect_right(losses, now)]
        if lately:
            found[location] = lately[-1] + NO_ROOM_S
    return found


def next_change(history: History, now: float, *, waits: bool, restless: bool) -> float:
    """Return when, if nothing happens, another location may be chosen; infinity for never.

    Args:
        waits: For the end of a pause; see `Plan`.
        restless: Somebody could be better off elsewhere.
    """
    supplies = history.of_places(history.failures, _outlook, _summed_up, now)
    times: list[float] = []
    if supplies.setup:
        times += _everywhere_changes(history, supplies.setup, now)
    if waits:
        pauses = backing_off(history, now)
        last = max([pause.since for pause in pauses.values()], default=-NEVER)
        times += [supplies.backoff_changes, last + EAGER_S]
    if restless:
        times += [pause.until for pause in supplies.recently_failed.values()]
    if waits or restless:  # a stand-in does not return to where one was just lost
        times += lost_lately(history, now).values()
    return min([at for at in times if at > now], default=NEVER)


def _everywhere_changes(history: History, setup: Sequence[Failure], now: float) -> Sequence[float]:
    pause = _everywhere(history, setup, now)
    if pause is None:
        return ()
    lately = [f for failures in history.failures.values() for f in _lately(failures, now)[0]]
    return (pause.until, *_shortened(lately, pause))


def _shortened(lately: Iterable[Failure], pause: Backoff) -> Sequence[float]:
    """Return when failures are forgiven by which a pause may end early."""
    forgiven = [f.at + FORGIVE_S for f in lately if f.at + FORGIVE_S < pause.until]
    if backoff_s(pause.failures - len(forgiven), pause.cause) < pause.until - pause.since:
        return forgiven
    return ()
