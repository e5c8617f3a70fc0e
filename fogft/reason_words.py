"""Reasons in words for people: command line, logs, reports. Nothing is decided from them."""

from __future__ import annotations

from collections.abc import Callable

from fogft.model.reason import Cause, Reason


def words(reason: Reason | None) -> str:
    """Return a reason in words, without a full stop; empty for none."""
    if reason is None:
        return ""
    make = _WORDS.get(reason.cause)
    if make is None:
        return _with_words(reason)
    return make if isinstance(make, str) else make(reason)


def _with_words(reason: Reason) -> str:
    name = reason.cause.value.replace("_", " ")
    rest = reason.words or _main(reason)
    return f"{name}: {rest}" if rest else name


def _main(reason: Reason) -> str:
    return words(reason.because[0]) if reason.because else ""


def _after(start: str, reason: Reason, sign: str = ": ") -> str:
    """Return how it starts, then the main reason where there is one."""
    main = _main(reason)
    return f"{start}{sign}{main}" if main else start


def _launch(start: str, market: tuple[Reason, ...]) -> str:
    return "; ".join([start, *map(words, market)])


def _usd(amount: float | None) -> str:
    return f"${max(amount or 0.0, 0.0):.3f}/h"


def _ms(seconds: float | None) -> str:
    return "unknown" if seconds is None else f"{seconds * 1000:.0f} ms"


def _all_backing_off(reason: Reason) -> str:
    places = ", ".join(f"`{one.location}`: {_name(one)}" for one in reason.because)
    return f"every location rests after failures ({places})"


def _name(reason: Reason) -> str:
    return reason.cause.value.replace("_", " ")


def _rests(reason: Reason) -> str:
    causes = ", ".join(map(_name, reason.because))
    if reason.seconds is None:
        return f"waiting after {reason.count} failed launches ({causes})"
    return f"rests {reason.seconds:.0f} s more after {reason.count} x {causes}"


def _target_unmet(reason: Reason) -> str:
    return (
        f"`availability: {reason.target:g}` cannot be met: {reason.count} replicas are expected "
        f"to reach {reason.share:.6g}, and {_main(reason)}"
    )


def _update_stopped(reason: Reason) -> str:
    return (
        f"update stopped, {_main(reason)}: the pool returns to the last good file, "
        f"{reason.count} of {reason.of} replicas run it"
    )


def _more_errors(reason: Reason) -> str:
    new, old = reason.because
    return (
        f"{new.count} of {new.of} requests to the new version failed, "
        f"{old.count} of {old.of} to the old one"
    )


def _launches_fail(reason: Reason) -> str:
    causes = ", ".join(map(_name, reason.because))
    return f"{reason.count} launches failed ({causes}), and none served"


def _run_ends(reason: Reason) -> str:
    detail = f" ({reason.words.splitlines()[0]})" if reason.words else ""
    return f"`run` ended {reason.count} times{detail}"


def _clock_set(reason: Reason) -> str:
    set_s = reason.seconds or 0.0
    where = "forward" if set_s > 0 else "back"
    return " and ".join(
        [f"the clock was set {where} by {abs(set_s):.0f} s", *map(words, reason.because)]
    )


def _impossible_price(reason: Reason) -> str:
    if reason.usd_per_hour is not None:
        return f"its price, {reason.usd_per_hour:g}, cannot be"
    if reason.location:
        return f"offers with impossible prices are ignored, such as `{reason.location}`"
    return "every offer has an impossible price"


def _over_budget(reason: Reason) -> str:
    if reason.slot is not None:
        return f"over the cap: it leaves {_usd(reason.limit_usd_per_hour)} for slot {reason.slot}"
    return (
        f"the cheapest offer is {_usd(reason.usd_per_hour)} and `max_usd_per_hour` "
        f"leaves {_usd(reason.limit_usd_per_hour)}"
    )


def _over_cap(reason: Reason) -> str:
    if reason.usd_per_hour is None:
        return "`max_usd_per_hour` allows no more"
    return (
        f"{_usd(reason.usd_per_hour)} is over the cap of ${reason.limit_usd_per_hour:g}/h: "
        "the dearest go, one by one"
    )


def _other_market(reason: Reason) -> str:
    other = "on demand" if reason.name == "spot" else "spot"
    return f"{reason.name}, where slot {reason.slot} is {other}"


def _worse_score(reason: Reason) -> str:
    chosen = reason.because[0]
    ours, theirs = reason.usd_per_hour or 0.0, chosen.usd_per_hour or 0.0
    far, near = reason.seconds, chosen.seconds
    said, better = [], False
    if ours != theirs:
        word = "dearer" if ours > theirs else "cheaper"
        said.append(f"{word}: ${ours:.3f}/h, not ${theirs:.3f}/h")
        better = ours < theirs
    if far != near:
        is_farther = near is not None and (far is None or far > near)
        said.append(f"{'farther' if is_farther else 'nearer'}: {_ms(far)}, not {_ms(near)}")
        better = better or not is_farther
    if not said:
        return f"as good as `{chosen.location}`, and later by name (slot {reason.slot})"
    return f"{(' but ' if better else ', ').join(said)} (slot {reason.slot})"


def _max_hours(reason: Reason) -> str:
    if reason.seconds is None:
        return "`max_hours` is over"
    hours = reason.seconds / 3600
    return f"its {hours:g} hours (`max_hours`) are over: the pool ends by itself"


_WORDS: dict[Cause, str | Callable[[Reason], str]] = {
    Cause.NOT_RUNNING: lambda r: f"not running after {r.seconds:.0f} s",
    Cause.NOT_READY: lambda r: f"not ready after {r.seconds:.0f} s",
    Cause.NOTICE: "preemption notice",
    Cause.DRAINS_ITSELF: "it asked to be left alone",
    Cause.SILENT: lambda r: f"silent for {r.seconds:.0f} s",
    Cause.DISAGREES: "its answers differ from those of the others",
    Cause.AT_RISK: "the cloud recommends to move it (rebalance)",
    Cause.SERVICE_AWAY: lambda r: f"its service has been away for {r.seconds:.0f} s",
    Cause.DRAINED: "drained by the user",
    Cause.EXCLUDED: lambda r: (
        f"excluded location {r.location}" if r.location else "excluded by `fogft exclude`"
    ),
    Cause.NO_GROUP: "its group is not in the pool file",
    Cause.OUTDATED: "outdated by another version",
    Cause.SUPERSEDED: lambda r: f"superseded by {r.replica}",
    Cause.BETTER_SPREAD: lambda r: f"moves to {r.location}: better spread",
    Cause.BETTER_SCORE: lambda r: f"moves to {r.location}: {r.share:.0%} better",
    Cause.SPOT_AGAIN: lambda r: f"moves to {r.location}: spot",
    Cause.ON_DEMAND_AGAIN: lambda r: f"moves to {r.location}: on demand",
    Cause.MAX_HOURS: _max_hours,
    Cause.NOT_WANTED: lambda r: _after("not wanted", r),
    Cause.REPLACED: lambda r: _after("replaced", r),
    Cause.REPLACED_FIRST: lambda r: _after("replaced, old before new", r),
    Cause.ENOUGH_SPOT: lambda r: _after("enough spot machines are ready", r),
    Cause.BUDGET_FULL: lambda r: f"{_main(r)}, and the budget has no room",
    Cause.REPLACES: lambda r: _launch(_after(f"replaces {r.replica}", r), r.because[1:]),
    Cause.FOLLOWS: lambda r: _launch(f"follows {r.replica}", r.because),
    Cause.NEW_SLOT: lambda r: _launch("fills a new slot", r.because),
    Cause.STANDS_IN: "stands in until enough spot machines are ready",
    Cause.FAILED_LONGEST_AGO: "all rest, and this location longest",
    Cause.NOTHING_OFFERED: "nothing is offered for these resources now",
    Cause.IMPOSSIBLE_PRICE: _impossible_price,
    Cause.LOCATION_FULL: "a location must not hold more of the replicas",
    Cause.ALL_EXCLUDED: "every offered location is excluded",
    Cause.BACKING_OFF: _rests,
    Cause.ALL_BACKING_OFF: _all_backing_off,
    Cause.OVER_BUDGET: _over_budget,
    Cause.SURGE_FULL: lambda r: (
        f"waiting to {'replace' if r.replica else 'launch'} slot {r.slot}: "
        "`max_surge` allows no more machines now"
    ),
    Cause.WAITS: lambda r: _after(f"slot {r.slot} waits", r),
    Cause.NO_ROOM_TO_UPDATE: lambda r: (
        f"slot {r.slot} is not updated: there is no room for both, and no other one that "
        "answers meanwhile; raise `max_usd_per_hour` or `max_surge`"
    ),
    Cause.OLD_BEFORE_NEW: lambda r: f"slot {r.slot}: no room for both, so old before new",
    Cause.OTHER_KIND: "nothing of its kind is launched",
    Cause.OTHER_MARKET: _other_market,
    Cause.WORSE_SCORE: _worse_score,
    Cause.LOST_THERE: lambda r: (
        f"avoided for {(r.seconds or 0.0) / 60:.0f} min more: a replica was lost there"
    ),
    Cause.CROWDED: lambda r: (
        f"spread: `{r.location}` has {r.count} already when slot {r.slot} is placed"
    ),
    Cause.SCHEDULED_AHEAD: "launching ahead of the schedule's next window",
    Cause.TARGET_UNMET: _target_unmet,
    Cause.MOST_REPLICAS: lambda r: f"{r.count} is the most",
    Cause.OVER_CAP: _over_cap,
    Cause.UPDATING: lambda r: (
        f"update in progress: {r.count} of {r.of} replicas run the new version"
    ),
    Cause.UPDATE_STOPPED: _update_stopped,
    Cause.ROLLED_BACK: lambda r: (
        f"update rolled back, {_main(r)}: the pool runs the last good file"
    ),
    Cause.REPLICA_FAILS: lambda r: _after(f"replica {r.replica}", r),
    Cause.TYPES_DIFFER: lambda r: r.words or "its types are not the same on both sides",
    Cause.RUN_ENDS: _run_ends,
    Cause.MORE_ERRORS: _more_errors,
    Cause.LAUNCHES_FAIL: _launches_fail,
    Cause.CLOUD_UNREACHABLE: "the cloud cannot be reached: nothing is changed",
    Cause.NO_ANSWER: lambda r: f"the cloud did not answer: {r.words}",
    Cause.NO_PRICES: lambda r: f"no prices can be had: {r.words}",
    Cause.UPLINK_SUSPECTED: "all links are silent together: the robot's uplink is suspected",
    Cause.NOBODY_HEARD: "nothing is ended while no replica can be heard",
    Cause.ENDS_SOON: lambda r: (
        f"the pool ends by itself in {(r.seconds or 0.0) / 60:.0f} min (`max_hours`)"
    ),
    Cause.CLOCK_SET: _clock_set,
    Cause.CLOCK_DOUBTED: lambda r: (
        f"the clock was set by {r.seconds:+.0f} s: nothing is launched or ended for it; "
        "schedules follow once it has stood for a minute"
    ),
    Cause.SLEPT: lambda r: f"this machine slept for {r.seconds:.0f} s",
    Cause.NO_MANAGER: "no manager runs: the cloud was asked directly",
    Cause.NO_PROXY_REPORT: "the client proxy has not reported yet",
    Cause.STALE_PROXY_REPORT: "the client proxy has not reported lately",
    Cause.PROXY_KEEPS_ENDING: lambda r: (
        f"the client proxy has ended {r.count} times in a row; its log is `{r.name}`"
    ),
    Cause.NO_CERTIFICATE: lambda r: (
        f"gateway `{r.name}` has no certificate: `fogft credentials issue gateway {r.name}`"
    ),
    Cause.NOT_OFFERED: lambda r: f"`{r.name}` is not offered here: {r.words}",
    Cause.TROUBLE: lambda r: r.words,
}
