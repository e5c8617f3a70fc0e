"""Take one time for a whole tick, and record clock jumps in the history.

Not here: detecting jumps (`planning.observed.clock_jumps`), shifting times (`history`, `updating`).
"""

import logging
import time
from collections.abc import Callable

from fogft.model.reason import Reason
from fogft.planning.observed.clock_jumps import Reading, Watch
from fogft.planning.observed.history import Event, EventKind
from fogft.pool.folder.store import PoolStore
from fogft.pool.manager.updating import Updating

log = logging.getLogger(__name__)


class Timekeeping:
    """The time of one manager's ticks."""

    def __init__(self, store: PoolStore, updating: Updating, clock: Callable[[], Reading]) -> None:
        self.now = 0.0
        self._store = store
        self._updating = updating
        self._clock = clock
        self.watch = Watch()  # how far the clock was set
        self._unwritten: list[tuple[EventKind, float, Reason]] = []

    def look(self) -> bool:
        """Read the clocks for a tick; return whether the time jumped.

        Raises StateError: a jump cannot be written; the next call tries again.
        """
        reading = self._clock()
        self.now = reading.wall_s
        jump = self.watch.look(reading)
        if jump is not None:
            log.error("clock_jumped set_s=%.1f slept_s=%.1f", jump.set_s, jump.slept_s)
            both = ((EventKind.CLOCK, jump.set_s), (EventKind.SLEPT, jump.slept_s))
            self._unwritten += [(kind, by_s, jump.reason) for kind, by_s in both if by_s]
        jumped = bool(self._unwritten)
        while self._unwritten:
            kind, by_s, reason = self._unwritten[0]
            self._updating.move(by_s, self.now)  # first: a full disk refuses it, not the event
            self._store.append(Event(self.now, kind, 0, 0, reason=reason, by_s=by_s))
            del self._unwritten[0]
        return jumped


_QUICK_S = 0.1
_TRIES = 10


def read() -> Reading:
    """Read all three clocks at one moment; again if the process was delayed between two."""
    for _ in range(_TRIES):
        awake_s = time.monotonic()
        steady_s = time.clock_gettime(time.CLOCK_BOOTTIME)
        found = Reading(time.time(), awake_s, steady_s)
        if time.monotonic() - awake_s < _QUICK_S:
            break
    return found
