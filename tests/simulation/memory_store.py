"""A store in memory that can crash its user at any write, and keeps only what was written."""

from __future__ import annotations

from collections.abc import Callable

from fogft.model.intent import Intent
from fogft.model.membership import is_newer
from fogft.model.replica import Membership
from fogft.model.spec import PoolSpec
from fogft.planning.observed.history import Event, History
from fogft.planning.rollout import Trial
from fogft.pool.folder.store import Identity


class MemoryStore:
    """What the reconciler uses of `PoolStore`; `crash_point` is called around every write."""

    def __init__(self, identity: Identity, spec: PoolSpec) -> None:
        self._identity = identity
        self.the_spec = spec
        self.the_good: PoolSpec | None = None
        self.the_trial = Trial()
        self.edits = 0  # counts files that were applied
        self.the_intent = Intent()
        self.events: list[Event] = []
        self.published: Membership | None = None
        self.crash_point: Callable[[], None] = lambda: None
        self._history = History()

    def identity(self) -> Identity:
        return self._identity

    def spec(self) -> PoolSpec:
        rejected = self.the_trial.fault and self.the_trial.file == self.applied()
        return self.the_good if rejected and self.the_good is not None else self.the_spec

    def applied(self) -> str:
        return f"{self.the_spec.replica_hash} {self.edits}"

    def good(self) -> PoolSpec | None:
        return self.the_good

    def keep_good(self, spec: PoolSpec) -> bool:
        self.crash_point()
        self.the_good = spec
        self.crash_point()
        return True

    def trial(self) -> Trial:
        return self.the_trial

    def write_trial(self, trial: Trial) -> None:
        self.crash_point()
        self.the_trial = trial
        self.crash_point()

    def intent(self) -> Intent:
        return self.the_intent

    def history(self) -> History:
        return self._history

    def append(self, event: Event) -> None:
        self.crash_point()
        self.events.append(event)
        self._history.add(event)
        self.crash_point()

    def membership(self) -> Membership | None:
        return self.published

    def write_membership(self, membership: Membership) -> None:
        self.crash_point()
        assert is_newer(membership, self.published), "a membership went back in time"
        self.published = membership
        self.crash_point()

    def reopen(self) -> None:
        """Forget what was only in memory, as a new process does."""
        self._history = History(self.events)
