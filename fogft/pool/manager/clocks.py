"""Read this machine's clocks together.

Owns: the system calls. Not here: what follows from them (`fogft.planning.observed.clock_jumps`).
"""

from __future__ import annotations

import time

from fogft.planning.observed.clock_jumps import Reading

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
