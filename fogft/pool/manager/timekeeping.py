"""Record in the history what happened to each replica and to the clock.

One tick has one time. Where the clock was set, or the machine slept, that is written into the
history first, and all that is remembered moves along.

Not here: what a jump is (`planning.observed.clock_jumps`), and what moves (`history`, `updating`).
"""

import logging
import time
from collections.abc import Callable

from fogft.model.reason import Cause, Reason
from fogft.model.replica import Observed, ReplicaId
from fogft.planning.observed.clock_jumps import Reading, Watch
from fogft.planning.observed.health import Health, Verdict
from fogft.planning.observed.history import Event, EventKind, History
from fogft.pool.folder.store import PoolStore
from fogft.pool.manager.updating import Updating
from fogft.reason_words import words


class Remembering:
    """Adds to a pool's history. Events are on disk before a method returns, or `StateError`.

    `clock` gives the observation's time: the plan that follows must not take a loss for something
    of the future, and go to the same place again.
    """

    def __init__(self, store: PoolStore, clock: Callable[[], float]) -> None:
        self._store = store
        self._clock = clock
        self._leaving: dict[ReplicaId, Reason] = {}  # when they were judged last

    def add(
        self,
        kind: EventKind,
        id: ReplicaId,
        *,
        location: str = "",
        reason: Reason | None = None,
        on_demand: bool = False,
        version: str = "",
    ) -> None:
        """Add one event."""
        at = self._clock()
        self._store.append(
            Event(at, kind, id.slot, id.generation, location, reason, on_demand, version=version)
        )

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
                why = None if record.ending else self._leaving.get(id, Reason(Cause.NOT_LISTED))
                self.add(kind, id, reason=why)

    def health(self, health: Health, history: History) -> None:
        """Record replicas that became ready, became unready or failed."""
        leaving = (judged for judged in health.replicas if judged.verdict is Verdict.LEAVING)
        self._leaving = {judged.id: judged.fault for judged in leaving if judged.fault}
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


log = logging.getLogger(__name__)


class Timekeeping:
    """The time of one manager's ticks."""

    def __init__(self, store: PoolStore, updating: Updating, clock: Callable[[], Reading]) -> None:
        self.now = 0.0
        self._store = store
        self._updating = updating
        self._clock = clock
        self._watch = Watch()
        self._unwritten: list[tuple[EventKind, float, Reason]] = []

    def look(self) -> bool:
        """Read the clocks for a tick; return whether the time jumped.

        Raises StateError where a jump cannot be written down; the next look tries again.
        """
        reading = self._clock()
        self.now = reading.wall_s
        jump = self._watch.look(reading)
        if jump is not None:
            log.error("clock_jumped set_s=%.1f slept_s=%.1f", jump.set_s, jump.slept_s)
            both = ((EventKind.CLOCK, jump.set_s), (EventKind.SLEPT, jump.slept_s))
            self._unwritten += [(kind, by_s, jump.reason) for kind, by_s in both if by_s]
        jumped = bool(self._unwritten)
        while self._unwritten:
            kind, by_s, reason = self._unwritten[0]
            self._store.append(Event(self.now, kind, 0, 0, reason=reason, by_s=by_s))
            del self._unwritten[0]
            self._updating.move(by_s)
        return jumped

    @property
    def doubt_s(self) -> float:
        """By how much the clock was just set; see `Observed.doubt_s`."""
        return self._watch.doubt_s


_QUICK_S = 0.1
_TRIES = 10


def read() -> Reading:
    """Read all three clocks at one moment, again where the process was held up between two."""
    for _ in range(_TRIES):
        awake_s = time.monotonic()
        steady_s = time.clock_gettime(time.CLOCK_BOOTTIME)
        found = Reading(time.time(), awake_s, steady_s)
        if time.monotonic() - awake_s < _QUICK_S:
            break
    return found
