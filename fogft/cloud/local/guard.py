"""What ties the processes of a machine together, so that none outlives the others.

The process that the cloud started forks: the child is the machine, the parent its guard,
which waits and then kills whatever is left. Both are subreapers, so even an orphan with a
clean environment stays below one of them. The guard shares the machine's lock: the machine
counts as alive until all of it is gone. If the guard is killed, the machine sees that its
parent changed, and ends.
"""

from __future__ import annotations

import ctypes
import logging
import os
import signal
from collections.abc import Callable

from fogft.errors import FogftError

log = logging.getLogger(__name__)

_PR_SET_CHILD_SUBREAPER = 36
_libc = ctypes.CDLL(None, use_errno=True)


def become_subreaper() -> None:
    """Inherit every orphan below this process, so that it stays a descendant."""
    _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def start(end_the_rest: Callable[[], None]) -> int:
    """Become the machine, before there are threads; return the process id of the guard above it."""
    become_subreaper()
    guard = os.getpid()
    machine = os.fork()
    if machine == 0:
        become_subreaper()  # it is not inherited
        return guard
    try:
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        while os.waitpid(-1, 0)[0] != machine:
            pass
        end_the_rest()
    except FogftError as error:
        log.error("guard_failed reason=%r", error.message)
    finally:
        os._exit(0)
