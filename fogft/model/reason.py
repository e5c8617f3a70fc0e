"""Reasons for events and delays: a cause with its data.

Decisions compare causes. Where people read a reason, `reason_words` puts it into words.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import ClassVar


class Cause(str, Enum):
    """The causes. Their values are used in files and in JSON and do not change."""

    # A launch was refused or has failed.
    CAPACITY = "capacity"  # full now: try another location, or later
    QUOTA = "quota"  # the account may not have more: waiting does not help
    CREDENTIALS = "credentials"  # expired, wrong, or without a permission
    SETUP = "setup"  # the pool file's `setup` failed: every place would do the same
    TIMEOUT = "timeout"  # it took too long
    ERROR = "error"
    NOT_RUNNING = "not_running"  # detail of a timeout: what did not happen in time
    NOT_READY = "not_ready"
    NOT_SET_UP = "not_set_up"

    # What is wrong with a replica.
    NOTICE = "preemption_notice"
    NOTICE_BY_REPLICA = "drains_itself"
    SILENT = "silent"
    DISAGREES = "disagrees"
    MISREAD = "misread"  # its answers are not messages of the type
    IGNORES = "ignores"  # it takes requests and never completes them
    AT_RISK = "at_risk"
    SERVICE_AWAY = "service_away"
    NOT_LISTED = "not_listed"  # its cloud no longer lists it, and gave no notice

    # Why a working replica is replaced.
    DRAINED = "drained"
    EXCLUDED = "excluded"
    CERTIFICATE_DUE = "certificate_due"  # its certificate expires soon
    NO_GROUP = "no_group"
    OUTDATED = "outdated"
    SUPERSEDED = "superseded"
    BETTER_SPREAD = "better_spread"
    BETTER_SCORE = "better_score"
    SPOT_AGAIN = "spot_again"  # it moves back to its intended market
    ON_DEMAND_AGAIN = "on_demand_again"

    # Why a replica ends now.
    DOWN = "down"
    MAX_HOURS = "max_hours"
    NOT_WANTED = "not_wanted"
    REPLACED = "replaced"
    REPLACED_FIRST = "replaced_first"  # before its successor exists
    ENOUGH_SPOT = "enough_spot"
    BUDGET_FULL = "budget_full"  # it blocks its own replacement

    # Why one is launched.
    REPLACES = "replaces"
    FOLLOWS = "follows"
    NEW_SLOT = "new_slot"
    STANDS_IN = "stands_in"  # on demand, until enough spot machines are ready
    FAILED_LONGEST_AGO = "failed_longest_ago"

    # Why nothing is launched, or this offer is not used.
    NOTHING_OFFERED = "nothing_offered"
    IMPOSSIBLE_PRICE = "impossible_price"
    LOCATION_FULL = "location_full"  # it would hold too many of the replicas
    ALL_EXCLUDED = "all_excluded"
    BACKING_OFF = "backing_off"
    ALL_BACKING_OFF = "all_backing_off"
    OVER_BUDGET = "over_budget"
    SURGE_FULL = "surge_full"
    WAITS = "waits"
    NO_ROOM_TO_UPDATE = "no_room_to_update"
    OLD_BEFORE_NEW = "old_before_new"
    OTHER_KIND = "other_kind"
    OTHER_MARKET = "other_market"
    CROWDED = "crowded"
    WORSE_SCORE = "worse_score"
    CHOSEN = "chosen"  # detail of a worse score: the offer chosen instead
    NEVER_READY = "never_ready"  # a version is given up: none of its launches ever served
    LAUNCH_LIMIT = "launch_limit"

    # How many are wanted.
    SCHEDULED_AHEAD = "scheduled_ahead"
    TARGET_UNMET = "target_unmet"
    FULL_TOGETHER = "full_together"
    MOST_REPLICAS = "most_replicas"
    OVER_CAP = "over_cap"

    # An update.
    UPDATING = "updating"
    UPDATE_STOPPED = "update_stopped"
    ROLLED_BACK = "rolled_back"
    REPLICA_FAILS = "replica_fails"
    TYPES_DIFFER = "types_differ"
    RUN_ENDS = "run_ends"
    MORE_ERRORS = "more_errors"
    REQUESTS_FAILED = "requests_failed"
    LAUNCHES_FAIL = "launches_fail"

    # What the manager cannot see or do.
    CLOUD_UNREACHABLE = "cloud_unreachable"
    NO_ANSWER = "no_answer"
    NO_PRICES = "no_prices"
    UPLINK_SUSPECTED = "uplink_suspected"
    NOBODY_HEARD = "nobody_heard"
    STOPPING = "stopping"
    ENDS_SOON = "ends_soon"
    CLOCK_SET = "clock_set"
    CLOCK_DOUBTED = "clock_doubted"
    SLEPT = "slept"
    NO_PROXY_REPORT = "no_proxy_report"
    STALE_PROXY_REPORT = "stale_proxy_report"
    PROXY_KEEPS_ENDING = "proxy_keeps_ending"
    NO_CERTIFICATE = "no_certificate"
    NO_RENDEZVOUS = "no_rendezvous"
    NOT_OFFERED = "not_offered"
    OUTVOTED = "outvoted"  # at most half of the replicas offer a service
    TROUBLE = "trouble"  # an error, in its own words

    @classmethod
    def _missing_(cls, value: object) -> Cause | None:
        return cls.TROUBLE if isinstance(value, str) else None  # of a newer fogft


@dataclass(frozen=True)
class Reason:
    """A cause with its data. Fields that do not apply to the cause keep their defaults."""

    omits_defaults: ClassVar[bool] = True  # plain data has only the cause and its own fields

    cause: Cause
    slot: int | None = None
    replica: str = ""  # ``slot.generation``
    location: str = ""  # ``cloud``, ``cloud/region`` or ``cloud/region/zone``
    name: str = ""  # of a service, a gateway or a file
    seconds: float | None = None  # how long, or until when
    count: int | None = None
    of: int | None = None  # the total that `count` is part of
    share: float | None = None  # of one, such as a gain or an availability
    target: float | None = None  # what `share` is compared with
    usd_per_hour: float | None = None
    limit_usd_per_hour: float | None = None  # what `usd_per_hour` is compared with
    words: str = ""  # text of a cloud, a program or an error: shown, never parsed
    because: tuple[Reason, ...] = ()  # the reasons that led to it, the main one first


NOTICES = (Cause.NOTICE, Cause.NOTICE_BY_REPLICA)
MOVES = frozenset(
    {Cause.BETTER_SPREAD, Cause.BETTER_SCORE, Cause.SPOT_AGAIN, Cause.ON_DEMAND_AGAIN}
)
"""Causes for moving a healthy replica to a better location."""


def because(reason: Reason | None) -> tuple[Reason, ...]:
    """Return the value of `Reason.because` for an optional reason."""
    return () if reason is None else (reason,)
