"""Roll out a changed pool file replica by replica, or roll it back. Pure.

A *version* is what a replica runs: `replica_hash` names it. The *good* file is the last one with
which the pool was fully ready. Rules: docs/design/rolling-update.md.

Not here: launches and endings (`planner`), stored state (`fogft.pool.manager.updating`).
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum

from fogft.model.groups import is_current, replica_hash
from fogft.model.reason import NOTICES, Cause, Reason, because
from fogft.model.replica import LinkState
from fogft.model.spec import PoolSpec
from fogft.planning.classification import Classification
from fogft.planning.observed.health import Assessment, Health, Verdict
from fogft.planning.observed.history import OWN_FAULTS, History, fault_of

# A new replica must serve this long before the next one is replaced, or its version is good.
SETTLE_S = 5.0
# Once `run` has ended this often, some eight seconds after its first start, it will not stay up.
CRASH_LOOP = 4
# This many launch failures, each of which may be the cloud's fault, are the version's fault.
CLOUD_FAILURES = 3
# Fewer errors than this are chance; the share of errors must exceed the old version's by this much.
ERRORS_MIN = 5
ERRORS_MARGIN = 0.02
_SURE = 3.0  # standard deviations: chance alone stops about one update in a thousand
_THE_CLOUDS = (Cause.CAPACITY, Cause.QUOTA, Cause.CREDENTIALS, Cause.NOT_LISTED, *NOTICES)


class UpdateState(str, Enum):
    """The state of an update. Only IN_PROGRESS can succeed."""

    IN_PROGRESS = "in progress"
    STOPPED = "stopped"  # given up; some of its replicas still exist, or good ones are missing
    ROLLED_BACK = "rolled back"  # the pool is fully ready with the good file


_NOTES = {
    UpdateState.IN_PROGRESS: Cause.UPDATING,
    UpdateState.STOPPED: Cause.UPDATE_STOPPED,
    UpdateState.ROLLED_BACK: Cause.ROLLED_BACK,
}


@dataclass(frozen=True)
class Trial:
    """The trial of the last applied file."""

    file: str = ""  # its digest: the rest applies to no other file
    began_at: float = 0.0  # when the manager first saw it, in seconds since the epoch
    fault: Reason | None = None  # why it was given up; None while it was not


@dataclass(frozen=True)
class Update:
    """An update's progress, for people and programs."""

    state: UpdateState
    done: int  # serving replicas of the version that is wanted now
    of: int  # how many are wanted
    fault: Reason | None = None  # why it was given up; None while it was not

    @property
    def reason(self) -> Reason:
        """The update as a note on the pool."""
        return Reason(_NOTES[self.state], count=self.done, of=self.of, because=because(self.fault))


def differs(spec: PoolSpec, good: PoolSpec, slots: Iterable[int]) -> bool:
    """Whether two files differ in the version of any of these slots."""
    return any(replica_hash(spec, slot) != replica_hash(good, slot) for slot in slots)


def fault(
    spec: PoolSpec, good: PoolSpec, health: Health, history: History, began_at: float
) -> Reason | None:
    """Return proof since the start of the update that the new version is bad; None without any.

    `health` was judged by `spec`, the file that is being applied.
    """
    old = [judged for judged in health.replicas if is_current(good, judged.machine)]
    current = [judged for judged in health.replicas if is_current(spec, judged.machine)]
    new = [judged for judged in current if judged not in old]
    for judged in new:
        if why := _does_not_start(judged):
            return Reason(Cause.REPLICA_FAILS, replica=judged.id.short, because=(why,))
    if why := _errors(new, old):
        return why
    if differs(spec, good, list(history.generations) or [0]):
        return _launches_fail(history, began_at)
    return None


def _does_not_start(judged: Assessment) -> Reason | None:
    why = judged.why
    if why is not None and judged.verdict is Verdict.FAILED and fault_of(why) in OWN_FAULTS:
        return replace(why, words=why.words.partition("\n")[0])
    link = judged.link
    if link is None or link.state is not LinkState.UP or judged.serving:
        return None
    if link.differs:
        return Reason(Cause.TYPES_DIFFER, words=link.detail)
    if link.restarts >= CRASH_LOOP:
        return Reason(Cause.RUN_ENDS, count=link.restarts, words=link.detail.partition("\n")[0])
    return None


def _errors(new: list[Assessment], old: list[Assessment]) -> Reason | None:
    """Return how the new version's share of errors is worse, if it surely is."""
    failed, asked = _counts(new)
    old_failed, old_asked = _counts(old)
    usual = old_failed / old_asked if old_asked else 0.0
    if failed < ERRORS_MIN or at_least(failed, asked) <= usual + ERRORS_MARGIN:
        return None
    counts = ((failed, asked), (old_failed, old_asked))
    shares = tuple(Reason(Cause.REQUESTS_FAILED, count=bad, of=all) for bad, all in counts)
    return Reason(Cause.MORE_ERRORS, because=shares)


def _counts(replicas: list[Assessment]) -> tuple[int, int]:
    links = [judged.link for judged in replicas if judged.link is not None]
    failed = sum(link.failed for link in links)
    return failed, failed + sum(link.answered for link in links)


def at_least(hits: int, of: int) -> float:
    """Return the lower end of Wilson's interval, at three standard deviations, for a share."""
    if not hits:  # exactly 0, whatever the rounding
        return 0.0
    share, square = hits / of, _SURE * _SURE
    spread = _SURE * math.sqrt(share * (1 - share) / of + square / (4 * of * of))
    return (share + square / (2 * of) - spread) / (1 + square / of)


def _launches_fail(history: History, began_at: float) -> Reason | None:
    """Return a reason if launches keep failing since the update began and none became ready."""
    proven_at = max((history.proven_at(place) for place in history.failures), default=began_at)
    since = max(began_at, proven_at)
    causes = [
        failure.cause
        for failures in history.failures.values()
        for failure in failures
        if failure.at > since and failure.cause not in _THE_CLOUDS
    ]
    if len(causes) < CLOUD_FAILURES:
        return None
    each = tuple(Reason(cause) for cause in sorted(set(causes)))
    return Reason(Cause.LAUNCHES_FAIL, count=len(causes), because=each)


def is_whole(spec: PoolSpec, health: Health, *, wanted: int, now: float, settle_s: float) -> bool:
    """Whether the wanted replicas are there, and all are of this file and served for `settle_s`."""
    if not health.links_known or health.uplink_suspected:
        return False
    stay = [judged for judged in health.replicas if judged.verdict is not Verdict.FAILED]
    if len(stay) < max(1, wanted):
        return False
    return all(
        judged.serving
        and judged.verdict is Verdict.GOOD
        and is_current(spec, judged.machine)
        and judged.ready_at is not None
        and not 0 <= now - judged.ready_at < settle_s
        for judged in stay
    )


def describe(
    spec: PoolSpec, good: PoolSpec | None, trial: Trial, health: Health, wanted: int
) -> Update | None:
    """Return the update in progress, or the one given up; None without one.

    `spec` is the file in force (after a rollback, the good one), by which `health` was judged.
    """
    if good is None:
        return None
    outdated = [judged for judged in health.replicas if not is_current(spec, judged.machine)]
    serving = sum(judged.serving for judged in health.replicas if judged not in outdated)
    done = min(serving, wanted)
    if trial.fault:
        back = not outdated and done >= wanted
        state = UpdateState.ROLLED_BACK if back else UpdateState.STOPPED
        return Update(state, done, wanted, trial.fault)
    # With the same file, replicas are outdated if another version of fogft launched them.
    is_same = not differs(spec, good, [judged.id.slot for judged in health.replicas])
    if is_same and all(judged.verdict is not Verdict.GOOD for judged in outdated):
        return None
    return Update(UpdateState.IN_PROGRESS, done, wanted)


# -- what the planner asks --------------------------------------------------------------------


def is_settling(machines: Classification, now: float) -> bool:
    """Whether the update waits for a new replica to prove itself."""
    if not any(s.is_outdated for s in machines.replaced):
        return False
    return any(
        s.was_ready_for(0.0, now) and not s.was_ready_for(SETTLE_S, now) for s in machines.good
    )


def may_go_first(replica: Assessment, machines: Classification, wanted: int) -> bool:
    """Whether an outdated replica may end before its successor exists: all others serve.

    So at least one always answers, and at most one is missing.
    """
    if not replica.may_serve:
        return True
    others = [s for s in (*machines.good, *machines.replaced) if s.id != replica.id]
    serving = sum(s.serving for s in others)
    return serving >= max(1, wanted - 1)


def has_room(spec: PoolSpec, usd_per_hour: float, cheapest: float) -> bool:
    """Whether a pool of this price may add one replica, at `cheapest`, during a replacement."""
    cap = spec.max_usd_per_hour
    return spec.max_surge > 0 and (cap is None or usd_per_hour + cheapest <= cap + 1e-9)
