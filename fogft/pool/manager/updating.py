"""Carry out updates of the pool file, and roll back to the last good one.

`up` writes neither the good file nor the trial: a trial is void for a file with another digest, so
the next `up` with a changed file tries again. After a kill at any point, the next tick continues.

Not here: the judgement (`fogft.planning.rollout`), the files themselves (`store`).
"""

import logging
from dataclasses import replace

from fogft.model.replica import Observed
from fogft.model.spec import PoolSpec
from fogft.planning import rollout
from fogft.planning.observed.clock_jumps import moved
from fogft.planning.observed.health import Health, judge
from fogft.planning.observed.history import Event, EventKind, History
from fogft.planning.rollout import Trial, Update
from fogft.pool.folder.store import PoolStore
from fogft.reason_words import words

log = logging.getLogger(__name__)


class Updating:
    """The updates of one pool. Raises `StateError` if the state cannot be stored."""

    def __init__(self, store: PoolStore) -> None:
        self._store = store

    def look(self, uid: str, observed: Observed, history: History) -> tuple[PoolSpec, Trial]:
        """Roll back the file being applied if necessary; return the file in force."""
        store = self._store
        spec, good, trial = store.spec(), store.good(), store.trial()
        if trial.file != store.applied():
            trial = Trial(store.applied(), began_at=observed.now)
            store.write_trial(trial)
            log.info("file_applied file=%s", trial.file)
            if good is not None:
                store.append(Event(observed.now, EventKind.UPDATING, 0, 0))
        if good is None or good is spec or trial.fault or observed.machines is None:
            return spec, trial
        health = judge(uid, spec, observed, history)
        fault = rollout.fault(spec, good, health, history, trial.began_at)
        if fault is None:
            return spec, trial
        trial = replace(trial, fault=fault)
        store.write_trial(trial)
        log.error("update_stopped file=%s reason=%r", trial.file, words(fault))
        store.append(Event(observed.now, EventKind.UPDATE_STOPPED, 0, 0, reason=fault))
        return store.spec(), trial

    def move(self, by_s: float, now: float) -> None:
        """Shift stored times, because the clock was set."""
        trial = self._store.trial()
        if trial.began_at:
            self._store.write_trial(replace(trial, began_at=moved(trial.began_at, by_s, now)))

    def settle(
        self, spec: PoolSpec, trial: Trial, health: Health, *, wanted: int, now: float
    ) -> Update | None:
        """Store the file as good once all replicas run it; return the update's state."""
        good = self._store.good()
        if not trial.fault and spec is not good and spec != good:
            settle_s = rollout.SETTLE_S if good is not None else 0.0
            is_whole = rollout.is_whole(spec, health, wanted=wanted, now=now, settle_s=settle_s)
            if is_whole and self._store.keep_good(spec):
                log.info("file_good file=%s", trial.file)
                good = spec
        return rollout.describe(spec, good, trial, health, wanted)
