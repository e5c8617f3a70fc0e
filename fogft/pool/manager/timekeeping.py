"""What time it is for a tick, whoever sets the clock meanwhile.

One tick has one time. Where the clock was set, or the machine slept, that is written into the
history first, and all that is remembered moves along (`planning.observed.clock_jumps`).

Owns: when a jump is looked for, and that none is lost.
Not here: what a jump is (`planning.observed.clock_jumps`), and what moves
(`planning.observed.history`, `updating`).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from fogft.model.reason import Cause, Reason
from fogft.planning.observed.clock_jumps import Reading, Watch
from fogft.planning.observed.history import Event, EventKind
from fogft.pool.folder.store import Store
from fogft.pool.manager.updating import Updating

log = logging.getLogger(__name__)


class Timekeeping:
    """The time of one manager's ticks.

    Args:
        reading: Tells in place of `clock` what time it is, and whether it was set; None where
            nobody sets it.
    """

    def __init__(
        self,
        store: Store,
        updating: Updating,
        clock: Callable[[], float],
        reading: Callable[[], Reading] | None,
    ) -> None:
        self.now = 0.0
        self._store = store
        self._updating = updating
        self._clock = clock
        self._reading = reading
        self._watch = Watch()
        self._unwritten: list[tuple[EventKind, float, Reason]] = []

    def look(self) -> bool:
        """Take the time of a tick; return whether it jumped.

        Raises:
            StateError: A jump cannot be written down. It is tried again at the next look.
        """
        if self._reading is None:
            self.now = self._clock()
            return False
        reading = self._reading()
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
        """By how much the clock was set just now; see `Observed.doubt_s`."""
        return self._watch.doubt_s

    @property
    def notes(self) -> list[Reason]:
        """What there is to say of it."""
        if not self.doubt_s:
            return []
        return [Reason(Cause.CLOCK_DOUBTED, seconds=self.doubt_s)]


_QUICK_S = 0.1
_TRIES = 10


def read() -> Reading:
    """Return all three as of one moment.

    A process that is held up between two of them would see a jump where there is none, so it
    reads again.
    """
    for _ in range(_TRIES):
        awake_s = time.monotonic()
        steady_s = time.clock_gettime(time.CLOCK_BOOTTIME)
        found = Reading(time.time(), awake_s, steady_s)
        if time.monotonic() - awake_s < _QUICK_S:
            break
    return found
