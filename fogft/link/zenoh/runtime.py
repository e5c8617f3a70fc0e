"""Which of Zenoh's tasks run in which threads.

By default a message passes through three of Zenoh's thread pools on its way, and each hop wakes
another thread. Callbacks need Python's lock anyway, so all that reads, routes and calls back runs
in *one* thread, which loses little: a round trip of 8 bytes over loopback took 168 us with one,
186 us with two and 257 to 271 us by default, and 133, 172 and 181 to 205 us of processor time
(medians of 3000, on 2 cores). So a callback that blocked would stall every link of the process:
none may.

Sending and closing have threads of their own, although it costs nothing to do without them.
Whoever sends something large holds a lock of its link while he waits for room there. When that
link breaks, Zenoh's sending task and its closing of the link wait for that lock, and block their
thread for up to `wait_before_close`: in the one thread, all other links would stand still as long.
So each may be blocked by several links, and none by another.

Zenoh reads the variable once, when its first session opens.
"""

from __future__ import annotations

import os
from collections.abc import MutableMapping

VARIABLE = "ZENOH_RUNTIME"
THREADS = (
    "(rx: (worker_threads: 1), app: (handover: rx), acc: (handover: rx),"
    " tx: (worker_threads: 8), net: (worker_threads: 8))"
)


def prepare(environ: MutableMapping[str, str] = os.environ) -> None:
    """Ask for these threads, unless the user has said otherwise."""
    environ.setdefault(VARIABLE, THREADS)


def forget(environ: MutableMapping[str, str]) -> None:
    """Take our wish out of the environment of another program, which may use Zenoh too."""
    if environ.get(VARIABLE) == THREADS:
        del environ[VARIABLE]
