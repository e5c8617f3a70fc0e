"""Judge what a pool file says about where, how many, when and at what price.

Owns: the sections `availability`, `placement`, `on_demand`, `groups`, `schedule` and
`migration`, and what cannot stand beside what.
Not here: what follows from them (`sizing`, `schedule`, `migration`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from fogft.model import schedule
from fogft.model.choices import (
    AvailabilitySpec,
    GroupSpec,
    MigrationSpec,
    OnDemandSpec,
    PlacementSpec,
    ScheduleSpec,
    TrafficSpec,
    WindowSpec,
)
from fogft.model.groups import CRITICAL, MAX_GROUPS
from fogft.model.scoring import Weights
from fogft.model.spec import MAX_REPLICAS
from fogft.planning.availability import Assumption, Correlation
from fogft.poolfile.keys import (
    AVAILABILITY_KEYS,
    CORRELATION_KEYS,
    DAY_S,
    GROUP_KEYS,
    MIGRATION_KEYS,
    ON_DEMAND_KEYS,
    PLACEMENT_KEYS,
    SCHEDULE_KEYS,
    TRAFFIC_KEYS,
    WINDOW_KEYS,
)
from fogft.poolfile.tree import Section, nearest, plain, shown

DAYS = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
MAX_TARGET = 0.99999
MAX_UPTIME_S = 1e9
MAX_PRELAUNCH_S = 21_600
_GROUP_NAME = re.compile(r"[a-z][a-z0-9-]{0,19}")
_LOCATION = re.compile(r"[\w.-]+(/[\w.-]+)?")
_CLOCK = re.compile(r"(\d{1,2}):(\d{2})")


def read_availability(ours: Section) -> AvailabilitySpec | None:
    """Return the target, and what is assumed; None where the file names none."""
    if not ours.has("availability"):
        return None
    if not isinstance(ours.children["availability"].value, Mapping):
        return AvailabilitySpec(ours.number("availability", MAX_TARGET, "one"))
    section = ours.section("availability")
    section.only(AVAILABILITY_KEYS)
    usual = Assumption()
    return AvailabilitySpec(
        target=section.number("target", MAX_TARGET, "one"),
        assumed=Assumption(
            section.number("spot_uptime_s", MAX_UPTIME_S, "seconds", usual.spot_uptime_s),
            section.number("on_demand_uptime_s", MAX_UPTIME_S, "seconds", usual.on_demand_uptime_s),
            section.number("recovery_s", DAY_S, "seconds", usual.recovery_s),
            _correlation(section),
        ),
    )


def _correlation(availability: Section) -> Correlation:
    section = availability.section("correlation")
    section.only(CORRELATION_KEYS)
    usual = Correlation()
    zone, region, cloud = (
        section.number(key, 1, "one", getattr(usual, key), zero=True) for key in CORRELATION_KEYS
    )
    if not zone >= region >= cloud:
        raise availability.error(
            "correlation",
            f"must not grow with the distance, as it does: {zone:g}, {region:g}, {cloud:g}",
            "write zone >= region >= cloud",
        )
    return Correlation(zone, region, cloud)


def read_placement(ours: Section) -> PlacementSpec:
    """Return how locations are weighed."""
    section = ours.section("placement")
    section.only(PLACEMENT_KEYS)
    usual = Weights()
    weights = Weights(
        section.number("price_weight", 100, "times", usual.price, zero=True),
        section.number("latency_weight", 100, "times", usual.latency, zero=True),
    )
    if not weights.price + weights.latency:
        raise section.error("price_weight", "is zero, and so is `latency_weight`", "weigh one")
    table = section.section("rtt_s", "write `{aws/us-west-2: 0.021}`")
    for place in table.children:
        if not _LOCATION.fullmatch(place):
            what = "is not a `cloud/region`"
            raise table.error(place, what, "write a place such as `aws/us-west-2`", at_key=True)
    rtt_s = {place: table.number(place, 60, "seconds") for place in table.children}
    return PlacementSpec(weights, _robot_at(section), rtt_s)


def _robot_at(section: Section) -> tuple[float, float] | None:
    if not section.has("robot_at"):
        return None
    found = plain(section.children["robot_at"])
    numbers = isinstance(found, list) and [
        n for n in found if isinstance(n, (int, float)) and not isinstance(n, bool)
    ]
    if not numbers or len(numbers) != 2 or len(found) != 2:
        what = f"must be a latitude and a longitude, not {shown(found)}"
        raise section.error("robot_at", what, "write degrees, such as `[37.87, -122.26]`")
    if not (-90 <= numbers[0] <= 90 and -180 <= numbers[1] <= 180):
        what = f"{shown(found)} is not on Earth"
        raise section.error("robot_at", what, "write `[latitude, longitude]` in degrees")
    return float(numbers[0]), float(numbers[1])


def read_on_demand(section: Section, replicas: int) -> OnDemandSpec:
    """Return how spot and on-demand are mixed among so many replicas."""
    section.only(ON_DEMAND_KEYS)
    base = section.whole("base", OnDemandSpec.base, 0, MAX_REPLICAS)
    if base > replicas:
        what = f"must not be above the {replicas} replicas that there are, and is {base}"
        raise section.error("base", what, "write fewer, or ask for more replicas")
    return OnDemandSpec(base, section.flag("fallback", OnDemandSpec.fallback))


def read_groups(ours: Section, task: Mapping[str, Any]) -> tuple[GroupSpec, ...]:
    """Return the groups; none where the file names none."""
    if not ours.has("groups"):
        return ()
    for key, instead in (
        ("replicas", "each group has its own `replicas`"),
        ("on_demand", "each group has its own `on_demand`"),
    ):
        if key in ours.children:
            raise ours.error(key, "cannot stand beside `groups`", instead, at_key=True)
    found: dict[str, GroupSpec] = {}
    sections = ours.sections("groups", "write `groups: [{name: anchor, replicas: 1, ...}]`")
    for section in sections:
        section.only(GROUP_KEYS)
        name = section.text("name", "write a name, such as `name: anchor`")
        if not _GROUP_NAME.fullmatch(name) or name == CRITICAL:
            hint = f"use lower-case letters, digits and dashes, at most 20, and not `{CRITICAL}`"
            raise section.error("name", f"{shown(name)} is not a group's name", hint)
        if name in found:
            raise section.error("name", f"`{name}` stands here twice", "name each group once")
        own = section.section("resources", "write resources as at the top level")
        replicas = section.whole("replicas", 1, 1, MAX_REPLICAS)
        found[name] = GroupSpec(
            name,
            replicas,
            {**(task.get("resources") or {}), **plain(own.node)},
            read_on_demand(section.section("on_demand"), replicas),
        )
    if len(found) > MAX_GROUPS:
        raise ours.error("groups", f"are {len(found)}, and at most {MAX_GROUPS} can be had")
    total = sum(group.replicas for group in found.values())
    if total > MAX_REPLICAS:
        raise ours.error("groups", f"ask for {total} replicas; at most {MAX_REPLICAS} can be had")
    return tuple(found.values())


def read_schedule(ours: Section) -> ScheduleSpec | None:
    """Return the schedule; None where the file has none."""
    if not ours.has("schedule"):
        return None
    section = ours.section("schedule", "write `time_zone` and `windows`")
    section.only(SCHEDULE_KEYS)
    zone = section.text("time_zone", "write a time zone, such as `time_zone: Europe/Berlin`")
    try:
        schedule.zone(zone)
    except ValueError:
        raise section.error(
            "time_zone",
            f"there is no time zone {shown(zone)} on this machine",
            "write a name of the IANA database, such as `America/Los_Angeles`, or `UTC`; the "
            "Debian package `tzdata` holds the database",
        ) from None
    windows = section.sections("windows", "write `windows: [{days: mon-fri, from: 8:00, ...}]`")
    return ScheduleSpec(
        zone,
        tuple(_window(window) for window in windows),
        section.number(
            "prelaunch_s", MAX_PRELAUNCH_S, "seconds", ScheduleSpec.prelaunch_s, zero=True
        ),
    )


def _window(section: Section) -> WindowSpec:
    section.only(WINDOW_KEYS)
    if not section.has("replicas") and not section.has("max_usd_per_hour"):
        raise section.error("replicas", "is missing, and so is `max_usd_per_hour`", "write one")
    begins, ends = _clock(section, "from", "0:00"), _clock(section, "to", "24:00")
    if begins == 86_400:
        raise section.error("from", "must be before 24:00", "write `from: 0:00`")
    if begins == ends:
        raise section.error("to", "must not be the same as `from`", "leave both out for all day")
    cap = None
    if section.has("max_usd_per_hour"):
        cap = section.number("max_usd_per_hour", 1_000_000, "US dollars per hour")
    return WindowSpec(
        _days(section),
        begins,
        ends or 86_400,
        section.whole("replicas", 0, 0, MAX_REPLICAS) if section.has("replicas") else None,
        cap,
    )


def _days(section: Section) -> frozenset[int]:
    if not section.has("days"):
        return frozenset(range(7))
    written = plain(section.children["days"])
    parts = written if isinstance(written, list) else str(written).split(",")
    found: set[int] = set()
    for part in parts:
        first, _, last = str(part).strip().lower().partition("-")
        for name in (first, last or first):
            if name not in DAYS:
                raise section.error("days", f"{shown(part)} is not a day", nearest(name, DAYS))
        begin, end = DAYS.index(first), DAYS.index(last or first)
        found |= {(begin + n) % 7 for n in range((end - begin) % 7 + 1)}
    return frozenset(found)


def _clock(section: Section, key: str, default: str) -> int:
    """Return a time of the day in seconds. YAML 1.1 reads 18:00 as the number 1080."""
    written = plain(section.children[key]) if section.has(key) else default
    minutes = written if isinstance(written, int) and not isinstance(written, bool) else -1
    match = _CLOCK.fullmatch(written) if isinstance(written, str) else None
    if match and int(match[2]) < 60:
        minutes = int(match[1]) * 60 + int(match[2])
    if not 0 <= minutes <= 24 * 60:
        what = f"{shown(written)} is not a time of the day"
        raise section.error(key, what, f"write hours and minutes, such as `{key}: 8:30`")
    return minutes * 60


def read_migration(ours: Section) -> MigrationSpec | None:
    """Return when replicas move; None for never (`migration: false`)."""
    if "migration" in ours.children and ours.children["migration"].value is False:
        return None
    section = ours.section("migration", "write `{gain: 0.3, stay_s: 3600}`, or `false` for never")
    section.only(MIGRATION_KEYS)
    return MigrationSpec(
        section.number("gain", 0.95, "one", MigrationSpec.gain),
        section.number("stay_s", 30 * DAY_S, "seconds", MigrationSpec.stay_s),
    )


def read_traffic(service: Section) -> TrafficSpec:
    """Return what is asked of a service, as far as the file says."""
    section = service.section("traffic", "write `{requests_per_s: 10, request_bytes: 100000}`")
    section.only(TRAFFIC_KEYS)
    return TrafficSpec(
        section.number("requests_per_s", 1e6, "requests", 0.0, zero=True),
        section.number("request_bytes", 1e10, "bytes", 0.0, zero=True),
        section.number("response_bytes", 1e10, "bytes", 0.0, zero=True),
    )
