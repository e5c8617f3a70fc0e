"""Reasons in words, for the command line, logs and reports. No decision depends on them."""

from collections.abc import Callable

from fogft.model.reason import Cause, Reason


def words(reason: Reason | None) -> str:
    """Return a reason in words, without a full stop; empty for none."""
    if reason is None:
        return ""
    found = _WORDS.get(reason.cause, "{name}{after}")
    if callable(found):
        return found(reason)
    main = reason.words or (words(reason.because[0]) if reason.because else "")
    return found.format(
        r=reason,
        main=main,
        after=f": {main}" if main else "",
        in_brackets=f" ({main})" if main else "",
        names=_names(reason),
        minutes=(reason.seconds or 0.0) / 60,
        name=_name(reason),
    )


def _name(reason: Reason) -> str:
    return reason.cause.value.replace("_", " ")


def _names(reason: Reason) -> str:
    return ", ".join(map(_name, reason.because))


def _launch(start: str, market: tuple[Reason, ...]) -> str:
    return "; ".join([start, *map(words, market)])


def _replaces(reason: Reason) -> str:
    why = "".join(f": {words(one)}" for one in reason.because[:1])
    return _launch(f"replaces {reason.replica}{why}", reason.because[1:])


def _all_backing_off(reason: Reason) -> str:
    places = ", ".join(f"`{one.location}`: {_name(one)}" for one in reason.because)
    return f"every location is backing off after failures ({places})"


def _backing_off(reason: Reason) -> str:
    if reason.seconds is None:
        return f"waiting after {reason.count} failed launches ({_names(reason)})"
    return f"backing off for {reason.seconds:.0f} s more after {reason.count} x {_names(reason)}"


def _clock_set(reason: Reason) -> str:
    set_s = reason.seconds or 0.0
    said = f"the clock was set {'forward' if set_s > 0 else 'back'} by {abs(set_s):.0f} s"
    return " and ".join([said, *map(words, reason.because)])


def _impossible_price(reason: Reason) -> str:
    if reason.usd_per_hour is not None:
        return f"its price, {reason.usd_per_hour:g}, is invalid"
    if reason.location:
        return f"offers with invalid prices are ignored, such as `{reason.location}`"
    return "every offer has an invalid price"


def _over_budget(reason: Reason) -> str:
    left = f"leaves ${reason.limit_usd_per_hour:.3f}/h"
    if reason.slot is not None:
        return f"over the cap: it {left} for slot {reason.slot}"
    return f"the cheapest offer is ${reason.usd_per_hour:.3f}/h and `max_usd_per_hour` {left}"


def _over_cap(reason: Reason) -> str:
    if reason.usd_per_hour is None:
        return "`max_usd_per_hour` allows no more"
    over = f"${reason.usd_per_hour:.3f}/h is over the cap of ${reason.limit_usd_per_hour:g}/h"
    return f"{over}: the most expensive replicas are ended one by one"


def _worse_score(reason: Reason) -> str:
    chosen = reason.because[0]
    ours, theirs = reason.usd_per_hour or 0.0, chosen.usd_per_hour or 0.0
    far, near = reason.seconds, chosen.seconds
    said, better = [], False
    if ours != theirs:
        word = "more expensive" if ours > theirs else "cheaper"
        said.append(f"{word}: ${ours:.3f}/h, not ${theirs:.3f}/h")
        better = ours < theirs
    if far != near:
        is_farther = near is not None and (far is None or far > near)
        said.append(f"{'farther' if is_farther else 'nearer'}: {_ms(far)}, not {_ms(near)}")
        better = better or not is_farther
    if not said:
        return f"as good as `{chosen.location}`, which comes first by name (slot {reason.slot})"
    return f"{(' but ' if better else ', ').join(said)} (slot {reason.slot})"


def _ms(seconds: float | None) -> str:
    return "unknown" if seconds is None else f"{seconds * 1000:.0f} ms"


def _never_ready(reason: Reason) -> str:
    said = (
        f"no replica of this file was ever ready, in {reason.count} launches: nothing more is "
        "launched until the file changes or `fogft retry`"
    )
    return f"{said}; the last one: {words(reason.because[0])}{reason.words}"


def _max_hours(reason: Reason) -> str:
    if reason.seconds is None:
        return "`max_hours` has passed"
    hours = reason.seconds / 3600
    return f"`max_hours` ({hours:g}) has passed: the pool is shutting down"


_WORDS: dict[Cause, str | Callable[[Reason], str]] = {
    Cause.NOT_RUNNING: "not running after {r.seconds:.0f} s",
    Cause.NOT_READY: "not ready after {r.seconds:.0f} s",
    Cause.NOT_SET_UP: "still setting up after {r.seconds:.0f} s",
    Cause.NOTICE: "preemption notice",
    Cause.NOTICE_BY_REPLICA: "preemption notice, reported by the replica",
    Cause.SILENT: "silent for {r.seconds:.0f} s",
    Cause.DISAGREES: "its answers differ from the other replicas'",
    Cause.MISREAD: "its answers cannot be read as responses of the service's type",
    Cause.IGNORES: "it takes requests and never answers them",
    Cause.AT_RISK: "the cloud recommends moving it (rebalance)",
    Cause.SERVICE_AWAY: "its service has been unavailable for {r.seconds:.0f} s",
    Cause.NOT_LISTED: "no longer listed by the cloud{after}",
    Cause.DRAINED: "drained by the user",
    Cause.CERTIFICATE_DUE: "its certificate is due for renewal",
    Cause.EXCLUDED: lambda r: (
        f"excluded location {r.location}" if r.location else "excluded by `fogft exclude`"
    ),
    Cause.NO_GROUP: "its group is not in the pool file",
    Cause.OUTDATED: "was launched from another pool file or by another version of fogft",
    Cause.SUPERSEDED: "superseded by {r.replica}",
    Cause.BETTER_SPREAD: "moves to {r.location}: better spread",
    Cause.BETTER_SCORE: "moves to {r.location}: {r.share:.0%} better",
    Cause.SPOT_AGAIN: "moves to {r.location}: spot",
    Cause.ON_DEMAND_AGAIN: "moves to {r.location}: on demand",
    Cause.MAX_HOURS: _max_hours,
    Cause.NOT_WANTED: "no longer needed{after}",
    Cause.REPLACED: "replaced{after}",
    Cause.REPLACED_FIRST: "replaced, old before new{after}",
    Cause.ENOUGH_SPOT: "enough spot machines are ready{after}",
    Cause.BUDGET_FULL: "{main}, and `max_usd_per_hour` leaves no room",
    Cause.REPLACES: _replaces,
    Cause.FOLLOWS: lambda r: _launch(f"successor of {r.replica}", r.because),
    Cause.NEW_SLOT: lambda r: _launch("fills a new slot", r.because),
    Cause.STANDS_IN: "fills in until enough spot machines are ready",
    Cause.FAILED_LONGEST_AGO: "all locations are backing off, this one the longest",
    Cause.NOTHING_OFFERED: "no cloud offers these resources at the moment",
    Cause.IMPOSSIBLE_PRICE: _impossible_price,
    Cause.LOCATION_FULL: "no location may hold more replicas",
    Cause.ALL_EXCLUDED: "every offered location is excluded",
    Cause.BACKING_OFF: _backing_off,
    Cause.ALL_BACKING_OFF: _all_backing_off,
    Cause.OVER_BUDGET: _over_budget,
    Cause.SURGE_FULL: lambda r: (
        f"waiting to {'replace' if r.replica else 'launch'} slot {r.slot}: "
        "`max_surge` allows no more machines now"
    ),
    Cause.WAITS: "slot {r.slot} is waiting{after}",
    Cause.NO_ROOM_TO_UPDATE: (
        "slot {r.slot} is not updated: there is no room for both, and no other replica "
        "to answer meanwhile; raise `max_usd_per_hour` or `max_surge`"
    ),
    Cause.OLD_BEFORE_NEW: "slot {r.slot}: no room for both, so old before new",
    Cause.OTHER_KIND: "no machine of this kind is needed",
    Cause.OTHER_MARKET: lambda r: (
        f"{r.name}, where slot {r.slot} is {'on demand' if r.name == 'spot' else 'spot'}"
    ),
    Cause.WORSE_SCORE: _worse_score,
    Cause.CROWDED: ("spread: `{r.location}` already has {r.count} when slot {r.slot} is placed"),
    Cause.NEVER_READY: _never_ready,
    Cause.LAUNCH_LIMIT: (
        "{r.count} machines were launched within an hour, which is the limit: the next one waits "
        "(`fogft events` shows why they ended, `fogft retry` goes on at once)"
    ),
    Cause.SCHEDULED_AHEAD: "launching ahead of the next schedule window",
    Cause.TARGET_UNMET: (
        "`availability: {r.target:g}` cannot be met: {r.count} replicas are expected "
        "to reach {r.share:.6g}, and {main}"
    ),
    Cause.FULL_TOGETHER: (
        "{r.share:.2%} of the time no location has spot capacity: on-demand "
        "machines (`fallback: true`) bridge that"
    ),
    Cause.MOST_REPLICAS: "{r.count} is the maximum",
    Cause.OVER_CAP: _over_cap,
    Cause.UPDATING: "update in progress: {r.count} of {r.of} replicas are up to date",
    Cause.UPDATE_STOPPED: (
        "update stopped, {main}: the pool returns to the last good file, "
        "{r.count} of {r.of} replicas run it"
    ),
    Cause.ROLLED_BACK: ("update rolled back, {main}: the pool runs the last good file"),
    Cause.REPLICA_FAILS: "replica {r.replica}{after}",
    Cause.TYPES_DIFFER: lambda r: r.words or "its types differ between robot and replica",
    Cause.RUN_ENDS: "`run` exited {r.count} times{in_brackets}",
    Cause.MORE_ERRORS: (
        "{r.because[0].count} of {r.because[0].of} requests to updated replicas failed, "
        "{r.because[1].count} of {r.because[1].of} to the others"
    ),
    Cause.LAUNCHES_FAIL: "{r.count} launches failed ({names}), and none served",
    Cause.CLOUD_UNREACHABLE: "the cloud cannot be reached: nothing is launched or ended",
    Cause.NO_ANSWER: "the cloud did not answer: {r.words}",
    Cause.NO_PRICES: "no prices are available: {r.words}",
    Cause.UPLINK_SUSPECTED: "all links are silent at once: the robot's uplink is suspected",
    Cause.NOBODY_HEARD: "nothing is ended while no replica can be reached",
    Cause.ENDS_SOON: "the pool shuts down in {minutes:.0f} min (`max_hours`)",
    Cause.CLOCK_SET: _clock_set,
    Cause.CLOCK_DOUBTED: (
        "the clock was set by {r.seconds:+.0f} s: nothing is launched or ended because of it; "
        "schedules adjust in a minute"
    ),
    Cause.SLEPT: "this machine slept for {r.seconds:.0f} s",
    Cause.NO_PROXY_REPORT: "the client proxy has not reported yet",
    Cause.STALE_PROXY_REPORT: "the client proxy has not reported lately",
    Cause.PROXY_KEEPS_ENDING: lambda r: (
        f"the client proxy {r.words or 'exited'}, {r.count} times in a row; see its log, `{r.name}`"
    ),
    Cause.NO_CERTIFICATE: (
        "gateway `{r.name}` has no certificate: `fogft credentials issue gateway {r.name}`"
    ),
    Cause.NO_RENDEZVOUS: "no rendezvous can be reached: {r.words}",
    Cause.NOT_OFFERED: "`{r.name}` is not offered here: {r.words}",
    Cause.OUTVOTED: (
        "`{r.name}` is not offered here: not more than half of {r.of} replicas offer it"
    ),
    Cause.TROUBLE: "{r.words}",
}
