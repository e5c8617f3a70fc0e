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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from fogft.core.history import Failure, History

BASE_S = 5.0
LIMIT_S = 600.0
FORGIVE_S = 3600.0
EVERYWHERE = "*"
EAGER_S = 60.0
AVOID_S = 300.0
AVOID_LIMIT_S = 3600.0
AVOID_MEMORY_S = 4 * 3600.0


@dataclass(frozen=True)
class Backoff:
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
    return history.of_places(_resting, now)


def _resting(history: History, now: float) -> Mapping[str, Backoff]:
    out: dict[str, Backoff] = {}
    setup_failures: list[Failure] = []
    for location, failures in history.failures.items():
        lately = _lately(failures, now)
        if not lately:
            continue
        setup_failures += [f for f in lately if f.cause == "setup"]
        proven_at = history.proven_at(location)
        rest = backoff([f for f in lately if f.cause != "setup" and f.at > proven_at], now)
        if rest is not None:
            out[location] = rest
    if setup_failures:
        proven_at = max(history.proven_at(place) for place in history.failures)
        everywhere = backoff([f for f in setup_failures if f.at > proven_at], now)
        if everywhere is not None:
            out[EVERYWHERE] = everywhere
    return out


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
    return history.of_places(_disappointing, now)


def _disappointing(history: History, now: float) -> Mapping[str, Backoff]:
    out: dict[str, Backoff] = {}
    for supply, failures in history.failures.items():
        lately = [f for f in _lately(failures, now) if f.at > history.proven_at(supply)]
        if lately:
            last = lately[-1]
            out[supply] = Backoff(last.at + FORGIVE_S, len(lately), last.cause, since=last.at)
    return out


def _lately(failures: Sequence[Failure], now: float) -> Sequence[Failure]:
    """Return those that still count, of failures in order of time."""
    if not failures or failures[-1].at <= now - FORGIVE_S:
        return ()
    first = end = len(failures)
    while end and failures[end - 1].at > now:
        end -= 1
    while first and failures[first - 1].at > now - FORGIVE_S:
        first -= 1
    return failures[first:end]


def backoff(failures: list[Failure], now: float) -> Backoff | None:
    """Return the rest that a run of failures earns, or None when it is over."""
    recent = sorted((f for f in failures if 0 <= now - f.at < FORGIVE_S), key=lambda f: f.at)
    if not recent:
        return None
    last = recent[-1]
    rest_s = min(BASE_S * 2.0 ** min(len(recent) - 1, 16), LIMIT_S)
    if last.cause == "quota":  # waiting a little does not help: the account is full
        rest_s = LIMIT_S
    if now >= last.at + rest_s:
        return None
    return Backoff(last.at + rest_s, len(recent), last.cause, since=last.at)


def avoided(history: History, now: float) -> Mapping[str, float]:
    """Return the locations to use only when no other is left, and until when."""
    return history.of_places(_avoided, now)


def _avoided(history: History, now: float) -> Mapping[str, float]:
    out: dict[str, float] = {}
    for location, losses in history.losses.items():
        first = bisect_right(losses, now - AVOID_MEMORY_S)
        recent = losses[first : bisect_right(losses, now, lo=first)]
        if recent:
            until = recent[-1] + min(AVOID_S * 2.0 ** min(len(recent) - 1, 16), AVOID_LIMIT_S)
            if now < until:
                out[location] = until
    return out


def next_change(history: History, now: float, *, needy: bool = True) -> float:
    """Return when, if nothing happens, another location may be chosen.

    Infinity for never. An older failure that is forgiven meanwhile may end a rest early.

    Args:
        needy: A machine is wanted that a rest keeps from being launched. Else only who could be
            better off elsewhere waits for anything.
    """
    times = [rest.until for rest in disappointing(history, now).values()]
    for location, rest in resting(history, now).items() if needy else ():
        places = list(history.failures) if location == EVERYWHERE else [location]
        forgiven = (f.at + FORGIVE_S for p in places for f in _lately(history.failures[p], now))
        times += [rest.since + EAGER_S, rest.until, *(at for at in forgiven if at < rest.until)]
    for location, until in avoided(history, now).items():
        forgotten = (at + AVOID_MEMORY_S for at in history.losses[location])
        times += [until, *(at for at in forgotten if at < until)]
    return min((at for at in times if at > now), default=float("inf"))
