"""How long a location is left alone after it disappointed. Pure.

A location sells spot machines and on-demand ones. Either supply may run short while the other
does not, so each rests by itself. Failures are refused launches (no capacity, no quota),
launches that failed, and replicas that died young. After n failures in a row a location rests for

    min(BASE_S * 2 ** (n - 1), LIMIT_S)

seconds from the last one. A replica that becomes ready there, or FORGIVE_S without a
failure, wipes the slate clean. A failed `setup` is the pool file's fault, not the
location's: it is counted against `EVERYWHERE`, so a broken file does not tour the world
at the user's expense.

A location where a replica was lost unasked is not at rest, but it is avoided: used only when
no other is left, for

    min(AVOID_S * 2 ** (n - 1), AVOID_LIMIT_S)

seconds after the last of n losses within AVOID_MEMORY_S.

When every location rests, waiting helps nobody: then the one that was left alone for longest is
tried, one try in EAGER_S. And a replica that could move, but need not, asks no location that
refused within FORGIVE_S and has not proved itself since. Events from the future, which a clock
that jumped back leaves behind, count for nothing.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from fogft.core.digest import Lasting
from fogft.core.history import Failure, History

BASE_S = 5.0
LIMIT_S = 600.0
FORGIVE_S = 3600.0
EVERYWHERE = "*"
NEVER = float("inf")
EAGER_S = 60.0
AVOID_S = 300.0
AVOID_LIMIT_S = 3600.0
AVOID_MEMORY_S = 4 * 3600.0


class Backoff(NamedTuple):
    """A location at rest.

    Attributes:
        since: Of the last failure, in seconds since the epoch.
        until: From then on it may be tried again.
        failures: How many in a row.
        cause: Of the last one: ``capacity``, ``quota``, ``setup``, ...
    """

    until: float
    failures: int
    cause: str
    since: float = 0.0


def resting(history: History, now: float) -> Mapping[str, Backoff]:
    """Return the supplies (`Placement.supply`) that must not be tried now, with the reason.

    The key `EVERYWHERE` means that nothing may be launched at all.
    """
    rests = history.of_supplies(_rest, now)
    everywhere = _everywhere(history, now)
    return rests if everywhere is None else {**rests, EVERYWHERE: everywhere}


def _rest(history: History, supply: str, now: float) -> Lasting[Backoff | None]:
    """Return a supply's rest, whatever was the pool file's fault left out."""
    lately, until = _lately(history.failures[supply], now)
    proven_at = history.proven_at(supply)
    rest = backoff([f for f in lately if f.cause != "setup" and f.at > proven_at], now)
    return Lasting(rest, now, until if rest is None else min(until, rest.until))


def _everywhere(history: History, now: float) -> Backoff | None:
    setup = [f for found in history.of_supplies(_setup, now).values() for f in found]
    if not setup:
        return None
    proven_at = max(history.proven_at(place) for place in history.failures)
    return backoff([f for f in setup if f.at > proven_at], now)


def _setup(history: History, supply: str, now: float) -> Lasting[Sequence[Failure] | None]:
    """Return the failures of late that are the pool file's fault."""
    lately, until = _lately(history.failures[supply], now)
    return Lasting([f for f in lately if f.cause == "setup"] or None, now, until)


def rested_longest(resting: Iterable[tuple[str, Backoff]], now: float) -> str | None:
    """Return the supply to try although it rests, as all do; None to wait.

    Only what had no room is tried: a full account or a launch that fails does not get better by it.
    """
    known = list(resting)
    if any(now - rest.since < EAGER_S for _, rest in known):
        return None
    full = [(rest.since, supply) for supply, rest in known if rest.cause == "capacity"]
    return min(full, default=(0.0, None))[1]


def disappointing(history: History, now: float) -> Mapping[str, Backoff]:
    """Return the supplies that failed within FORGIVE_S and have not proved themselves since."""
    return history.of_supplies(_disappointment, now)


def _disappointment(history: History, supply: str, now: float) -> Lasting[Backoff | None]:
    lately, until = _lately(history.failures[supply], now)
    proven_at = history.proven_at(supply)
    bad = [f for f in lately if f.at > proven_at]
    if not bad:
        return Lasting(None, now, until)
    last = bad[-1]
    return Lasting(Backoff(last.at + FORGIVE_S, len(bad), last.cause, since=last.at), now, until)


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
    """Return the rest that a run of failures earns, or None when it is over."""
    recent = sorted((f for f in failures if 0 <= now - f.at < FORGIVE_S), key=lambda f: f.at)
    if not recent:
        return None
    last = recent[-1]
    # Waiting a little does not help where the account is full.
    until = last.at + (LIMIT_S if last.cause == "quota" else rest_s(len(recent)))
    return None if now >= until else Backoff(until, len(recent), last.cause, since=last.at)


def rest_s(failures: int) -> float:
    """Return how long so many failures in a row make a location rest, in seconds."""
    return min(BASE_S * 2.0 ** min(max(failures, 1) - 1, 16), LIMIT_S)


def avoided(history: History, now: float) -> Mapping[str, float]:
    """Return the locations to use only when no other is left, and until when."""
    return history.of_losses(_avoidance, now)


def _avoidance(history: History, location: str, now: float) -> Lasting[float | None]:
    """Return until when a location is avoided; None if it is not."""
    losses = history.losses[location]
    first = bisect_right(losses, now - AVOID_MEMORY_S)
    end = bisect_right(losses, now, lo=first)
    holds = losses[end] if end < len(losses) else NEVER
    if first == end:
        return Lasting(None, now, holds)
    until = losses[end - 1] + min(AVOID_S * 2.0 ** min(end - first - 1, 16), AVOID_LIMIT_S)
    holds = min(holds, losses[first] + AVOID_MEMORY_S)
    if until <= now:
        return Lasting(None, now, holds)
    return Lasting(until, now, min(holds, until))


def next_change(history: History, now: float, *, waits: bool, restless: bool) -> float:
    """Return when, if nothing happens, another location may be chosen; infinity for never.

    Args:
        waits: For the end of a rest; see `Plan`.
        restless: Somebody could be better off elsewhere.
    """
    times: list[float] = []
    rests = resting(history, now)
    if waits and rests:
        times.append(max(rest.since for rest in rests.values()) + EAGER_S)
    for supply, rest in rests.items():
        if waits or supply == EVERYWHERE:
            times += [rest.until, *_shortened(history, supply, rest, now)]
    if restless:
        times += [rest.until for rest in disappointing(history, now).values()]
    if waits or restless:  # a stand-in does not return to where one was just lost
        for location, until in avoided(history, now).items():
            forgotten = (at + AVOID_MEMORY_S for at in history.losses[location])
            times += [until, *(at for at in forgotten if at < until)]
    return min((at for at in times if at > now), default=NEVER)


def _shortened(history: History, supply: str, rest: Backoff, now: float) -> Iterator[float]:
    """Yield when failures are forgiven by which a rest may end early."""
    places = list(history.failures) if supply == EVERYWHERE else [supply]
    lately = [f for place in places for f in _lately(history.failures[place], now)[0]]
    forgiven = [f.at + FORGIVE_S for f in lately if f.at + FORGIVE_S < rest.until]
    if rest_s(rest.failures - len(forgiven)) < rest.until - rest.since:
        yield from forgiven
