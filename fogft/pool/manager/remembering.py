"""Write down what was seen to happen to each replica, once: it became ready, failed, went.

Owns: which observation is an event.
Not here: when to look (`reconciler`) and where it is stored (`store`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from fogft.model.reason import Reason
from fogft.model.replica import Observed, ReplicaId
from fogft.planning.observed.health import Health, Verdict
from fogft.planning.observed.history import Event, EventKind, History
from fogft.pool.folder.store import Store
from fogft.reason_words import words

log = logging.getLogger(__name__)


class Remembering:
    """Adds to a pool's history. Events are on disk before a method returns, or `StateError`."""

    def __init__(self, store: Store, clock: Callable[[], float]) -> None:
        self._store = store
        self._clock = clock

    def add(
        self,
        kind: EventKind,
        id: ReplicaId,
        *,
        location: str = "",
        reason: Reason | None = None,
        on_demand: bool = False,
        at: float | None = None,
        version: str = "",
    ) -> None:
        """Add one event, of now unless told."""
        when = self._clock() if at is None else at
        self._store.append(
            Event(when, kind, id.slot, id.generation, location, reason, on_demand, version=version)
        )

    def losses(self, observed: Observed) -> None:
        """Note who is no longer listed. The cloud's list must be known.

        It went when it was observed, not a moment later: the plan of the same observation must
        not take the loss for something of the future, and go to the same place again.
        """
        uid = self._store.identity().uid
        ids = [m.id for m in observed.machines or ()]
        listed = {(id.slot, id.generation) for id in ids if id.pool_uid == uid}
        for record in self._store.history().open():
            if (record.slot, record.generation) not in listed:
                id = ReplicaId(uid, record.slot, record.generation)
                kind = EventKind.ENDED if record.ending else EventKind.GONE
                log.info("replica_%s replica=%s zone=%s", kind.value, id.short, record.location)
                self.add(kind, id, at=observed.now)

    def health(self, health: Health, history: History, now: float) -> None:
        """Note who became ready, stopped to be, or failed; judged by this very history."""
        for judged in health.replicas:
            machine, record = judged.machine, judged.record
            id = machine.id
            if record is None or record.closed is not None:  # the cloud's list is the record
                place = machine.placement
                self.add(
                    EventKind.LAUNCH,
                    id,
                    location=place.location,
                    on_demand=not place.spot,
                    at=now,
                    version=machine.spec_hash,
                )
                record = history.record(id.slot, id.generation)
            if record is None:
                continue
            if judged.serving:
                if record.first_ready_at is None or record.unready_since:
                    log.info("replica_ready replica=%s zone=%s", id.short, record.location)
                    self.add(EventKind.READY, id, at=now)
            elif record.first_ready_at and not record.unready_since and judged.answers:
                log.warning("replica_unready replica=%s zone=%s", id.short, record.location)
                self.add(EventKind.UNREADY, id, at=now)
            if judged.verdict is Verdict.FAILED and not (record.failed or record.ending):
                log.warning("replica_failed replica=%s reason=%r", id.short, words(judged.why))
                self.add(EventKind.FAILED, id, reason=judged.why, at=now)
