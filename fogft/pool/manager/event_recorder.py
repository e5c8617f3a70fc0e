"""Record in the history what happened to each replica, and why.

Not here: what events mean (`planning.observed.history`), and clock events (`timekeeping`).
"""

import logging
from collections.abc import Callable
from typing import Any

from fogft.model.reason import NOTICES, Cause, Reason, because
from fogft.model.replica import Observed, ReplicaId
from fogft.planning.observed.health import Health, Verdict
from fogft.planning.observed.history import Event, EventKind, History
from fogft.pool.folder.store import PoolStore
from fogft.reason_words import words

log = logging.getLogger(__name__)


class EventRecorder:
    """Adds events to a pool's history. Raises `StateError` for a launch that cannot be written.

    `clock` gives the time of the observation: otherwise the plan that follows would ignore a loss
    as an event in the future, and choose the same location again.
    """

    def __init__(self, store: PoolStore, clock: Callable[[], float]) -> None:
        self._store = store
        self._clock = clock
        self._faults: dict[ReplicaId, Reason] = {}  # by the last `health`

    def add(self, kind: EventKind, id: ReplicaId, **more: Any) -> None:
        """Add one event; `more` as for `Event`."""
        self._store.append(Event(self._clock(), kind, id.slot, id.generation, **more))

    def losses(self, observed: Observed) -> None:
        """Record replicas that are no longer listed. The cloud's list must be known."""
        uid = self._store.identity().uid
        ids = [m.id for m in (*(observed.machines or ()), *observed.gateway)]
        listed = {(id.slot, id.generation) for id in ids if id.pool_uid == uid}
        for record in self._store.history().open():
            if (record.slot, record.generation) not in listed:
                id = ReplicaId(uid, record.slot, record.generation)
                kind = EventKind.ENDED if record.ending else EventKind.GONE
                log.info("replica_%s replica=%s zone=%s", kind.value, id.short, record.location)
                fault = self._faults.get(id)
                gone = Reason(Cause.NOT_LISTED, because=because(fault))
                if fault is not None and fault.cause in NOTICES:
                    gone = fault
                self.add(kind, id, reason=record.ends_for if record.ending else gone)

    def health(self, health: Health, history: History) -> None:
        """Record replicas that became ready, became unready or failed."""
        self._faults = {judged.id: judged.fault for judged in health.replicas if judged.fault}
        for judged in health.replicas:
            machine, record = judged.machine, judged.record
            id = machine.id
            if record is None or record.closed is not None:  # the cloud's list decides
                place = machine.placement
                self.add(
                    EventKind.LAUNCH,
                    id,
                    location=place.location,
                    on_demand=not place.spot,
                    version=machine.spec_hash,
                )
                record = history.record(id.slot, id.generation)
            if record is None:
                continue
            if judged.serving:
                if record.first_ready_at is None or record.unready_since:
                    log.info("replica_ready replica=%s zone=%s", id.short, record.location)
                    self.add(EventKind.READY, id)
            elif record.first_ready_at and not record.unready_since and judged.answers:
                log.warning("replica_unready replica=%s zone=%s", id.short, record.location)
                self.add(EventKind.UNREADY, id)
            if judged.verdict is Verdict.FAILED and not (record.failed or record.ending):
                log.warning("replica_failed replica=%s reason=%r", id.short, words(judged.why))
                self.add(EventKind.FAILED, id, reason=judged.why)
