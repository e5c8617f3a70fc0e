"""Replicas and cap by time of the week. Pure: `now` is an argument."""

import datetime
import zoneinfo
from typing import NamedTuple

from fogft.model.choices import ScheduleSpec, WindowSpec
from fogft.model.keys import DAY_S
from fogft.model.spec import PoolSpec


class Wish(NamedTuple):
    """The desired replicas and cap at a time; `ahead` if for a window that has not begun."""

    replicas: int
    max_usd_per_hour: float | None
    ahead: bool = False


def zone(name: str) -> datetime.tzinfo:
    """Return a time zone by its name. Raises ValueError if this machine does not know it."""
    if name == "UTC":
        return datetime.timezone.utc
    try:
        return zoneinfo.ZoneInfo(name)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise ValueError(f"there is no time zone {name!r}") from error


def window_at(schedule: ScheduleSpec, moment: float) -> WindowSpec | None:
    """Return the first window that contains a time (seconds since the epoch)."""
    local = datetime.datetime.fromtimestamp(moment, zone(schedule.time_zone))
    second = local.hour * 3600 + local.minute * 60 + local.second
    today = local.weekday()
    return next((w for w in schedule.windows if _holds(w, today, second)), None)


def wish(spec: PoolSpec, now: float) -> Wish:
    """Return the replicas and the cap that the file wants now.

    Within `prelaunch_s` before a window that wants more replicas, its number and the higher of
    both caps apply. Each minute of that time is checked: a window may be shorter than it.
    """
    schedule, usual = spec.schedule, Wish(spec.replicas, spec.max_usd_per_hour)
    if schedule is None:
        return usual
    current = best = _within(window_at(schedule, now), usual)
    ahead_s = 60.0
    while ahead_s < schedule.prelaunch_s + 60.0:
        moment = now + min(ahead_s, schedule.prelaunch_s)
        later = _within(window_at(schedule, moment), usual)
        if later.replicas > best.replicas:
            caps = (current.max_usd_per_hour, later.max_usd_per_hour)
            cap = None if None in caps else max(c for c in caps if c is not None)
            best = Wish(later.replicas, cap, ahead=True)
        ahead_s += 60.0
    return best


def _within(window: WindowSpec | None, usual: Wish) -> Wish:
    if window is None:
        return usual
    replicas = usual.replicas if window.replicas is None else window.replicas
    cap = usual.max_usd_per_hour if window.max_usd_per_hour is None else window.max_usd_per_hour
    return Wish(replicas, cap)


def _holds(window: WindowSpec, today: int, second: int) -> bool:
    if window.begins_s < window.ends_s:
        return today in window.days and window.begins_s <= second < window.ends_s
    yesterday = (today - 1) % 7
    return (today in window.days and second >= window.begins_s) or (
        yesterday in window.days and second < window.ends_s
    )


def next_change(schedule: ScheduleSpec, now: float) -> float:
    """Return the next time that `wish` may change: a window begins, is near or ends.

    If local time is shifted before then, the result may be early, but never late.
    """
    local = datetime.datetime.fromtimestamp(now, zone(schedule.time_zone))
    second = local.hour * 3600 + local.minute * 60 + local.second + local.microsecond / 1e6
    times = {float(t) for w in schedule.windows for t in (w.begins_s, w.ends_s)}
    times |= {t - schedule.prelaunch_s for t in times}  # of ends too: more may be wanted after
    shifted = {t + shift for t in times for shift in (-3600.0, 0.0, 3600.0)}
    return now + min((t - second) % DAY_S or DAY_S for t in shifted)
