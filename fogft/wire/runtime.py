"""One thread for all of Zenoh's tasks, instead of a pool for each kind of them.

By default a message passes through three of Zenoh's thread pools on its way, and each hop
wakes another thread. Callbacks need Python's lock anyway, so one worker loses little: a
round trip of 8 bytes over loopback took 168 us with one, 186 us with two and 257 to 271 us
by default, and 133, 172 and 181 to 205 us of processor time (medians of 3000, on 2 cores).
So a callback that blocked would stall every link of the process: none may.

Zenoh reads the variable once, when its first session opens.
"""

from __future__ import annotations

import os
from collections.abc import MutableMapping

VARIABLE = "ZENOH_RUNTIME"
ONE_WORKER = (
    "(net: (worker_threads: 1), rx: (handover: net), tx: (handover: net),"
    " acc: (handover: net), app: (handover: net))"
)


def prepare(environ: MutableMapping[str, str] = os.environ) -> None:
    """Ask for one worker, unless the user has said otherwise."""
    environ.setdefault(VARIABLE, ONE_WORKER)


def forget(environ: MutableMapping[str, str]) -> None:
    """Take our wish out of the environment of another program, which may use Zenoh too."""
    if environ.get(VARIABLE) == ONE_WORKER:
        del environ[VARIABLE]
