"""The outcome of an `up`: the pool answers, is still starting, or cannot answer. Pure.

Owns: the verdict on a status.
Not here: polling and waiting (`fogft.cli.progress`).
"""

from dataclasses import dataclass
from enum import Enum, auto

from fogft.model.reason import Cause
from fogft.model.replica import Phase
from fogft.planning.rollout import UpdateState
from fogft.pool.commands.status import Seen
from fogft.pool.manager.status import ReplicaStatus

HOPELESS_RESTARTS = 4  # of `run`, some eight seconds after it was first started
AGAIN_S = 16.0  # by then, a `run` that ended before the `up` has been restarted


class Outcome(Enum):
    """The possible outcomes of an `up`."""

    PENDING = auto()
    ANSWERING = auto()
    WITHDRAWN = auto()  # the update was stopped and rolled back
    RUN_KEEPS_ENDING = auto()  # on every replica
    NEVER_READY = auto()  # no replica was ever ready: nothing more is launched
    TYPES_DIFFER = auto()  # every replica has another type for a service than this machine


@dataclass(frozen=True)
class Awaited:
    """The condition that an `up` waits for.

    Attributes:
        services: Their names; empty if they are to be discovered.
        since: When the file was applied, in seconds since the epoch.
        digest: The digest of the file whose update is awaited; empty for no update.
    """

    services: frozenset[str]
    since: float
    digest: str = ""

    def outcome(self, seen: Seen, *, is_last: bool = False) -> Outcome:
        """Return the outcome for a status; `is_last` if no time is left to wait for an update."""
        if self.is_updating(seen) and not is_last:
            hopeless = seen.status.applied == self.digest and keeps_ending(seen)
            return Outcome.RUN_KEEPS_ENDING if hopeless else Outcome.PENDING
        update, is_new = seen.status.update, seen.status.observed_at >= self.since
        if is_new and update is not None and update.fault:
            return Outcome.WITHDRAWN
        if self.is_answering(seen):
            return Outcome.ANSWERING
        if types_differ(seen):
            return Outcome.TYPES_DIFFER
        if keeps_ending(seen) and seen.status.observed_at >= self.since + AGAIN_S:
            return Outcome.RUN_KEEPS_ENDING
        return Outcome.NEVER_READY if is_given_up(seen) and is_new else Outcome.PENDING

    def is_updating(self, seen: Seen) -> bool:
        """Whether the awaited update is still in progress."""
        if not self.digest:
            return False
        update = seen.status.update
        return seen.status.applied != self.digest or (
            update is not None and update.state != UpdateState.ROLLED_BACK.value
        )

    def is_answering(self, seen: Seen) -> bool:
        """Whether every service has enough ready replicas and a client proxy."""
        status = seen.status
        if status.observed_at < self.since:
            return False
        if status.cloud_reachable and not status.target:  # its schedule wants no replica now
            return True
        names = {service.name for service in status.services}
        ready = {service.name for service in status.services if service.answers}
        return status.proxy_alive and bool(ready) and names == (self.services or ready) == ready


@dataclass(frozen=True)
class Settled:
    """What `scale` and `drain` wait for: all replicas ready, none draining, and `gone` ended."""

    since: float
    gone: tuple[int, int] | None = None  # a slot, and the last generation that must have ended

    def outcome(self, seen: Seen, *, is_last: bool = False) -> Outcome:
        """Return the outcome for a status."""
        del is_last
        status = seen.status
        draining = [
            one
            for one in status.replicas
            if one.phase == Phase.DRAINING.value
            or (self.gone and one.slot == self.gone[0] and one.generation <= self.gone[1])
        ]
        if status.observed_at < self.since or draining or status.ready < status.target:
            return Outcome.PENDING
        return Outcome.ANSWERING


def is_given_up(seen: Seen) -> bool:
    """Whether launching was given up, and no launched replica may still become ready."""
    gave_up = any(reason.cause is Cause.NEVER_READY for reason in seen.status.reasons)
    return gave_up and not seen.status.replicas


def staying(seen: Seen) -> list[ReplicaStatus]:
    """Return the replicas that are not draining; those of an earlier file are."""
    return [one for one in seen.status.replicas if one.phase != Phase.DRAINING.value]


def keeps_ending(seen: Seen) -> bool:
    """Whether `run` has exited so often on every replica that waiting is pointless."""
    replicas = staying(seen)
    return bool(replicas) and not any(
        replica.phase == Phase.READY.value or replica.restarts < HOPELESS_RESTARTS
        for replica in replicas
    )


def types_differ(seen: Seen) -> bool:
    """Whether every replica has another type for a service than this machine."""
    replicas = staying(seen)
    return bool(replicas) and all(replica.differs for replica in replicas)
