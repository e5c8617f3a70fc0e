"""A start with less work: no garbage collected meanwhile, no threads that numpy would start.

ROS's types load numpy, whose OpenBLAS starts a thread for each further core. Each spins before it
sleeps: 30 to 100 ms of processor time of a proxy's start, for arithmetic that a proxy never does.

What a start makes lives as long as the process. To look through it for garbage costs the start
some 40 ms, and later, now and then, a pause of many milliseconds.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
from collections.abc import MutableMapping

_THREADS = "OPENBLAS_NUM_THREADS"


def load_numpy(environ: MutableMapping[str, str] = os.environ) -> None:
    """Load numpy without threads, unless the user has said how many."""
    if _THREADS in environ:
        return
    environ[_THREADS] = "1"  # OpenBLAS reads it as it is loaded
    try:
        with contextlib.suppress(Exception):  # what is wrong with it, its next user tells
            importlib.import_module("numpy")
    finally:
        del environ[_THREADS]


def begin() -> None:
    """Collect no garbage until `settle`."""
    gc.disable()


def settle() -> None:
    """Collect garbage again, but never look at what is there now."""
    gc.freeze()
    gc.enable()
