"""Take processor time away from a process, as a hypervisor does from a VM: contention.

The process is stopped and let go on in turns, so that it runs for a small share of the time.
It does not know, and nothing else on this machine becomes slower.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence

PERIOD_S = 0.02  # of one turn, when the machine is idle


class Stolen:
    """What was taken.

    Attributes:
        stops: How often the processes were stopped.
        seconds: How long they were stopped in all.
    """

    def __init__(self) -> None:
        self.stops = 0
        self.seconds = 0.0


@contextlib.contextmanager
def steal(pids: Sequence[int], factor: float) -> Iterator[Stolen]:
    """Make processes about so many times slower while the block runs; they run on after it.

    Args:
        pids: Their ids; none for nothing. Whoever has ended is left out.
        factor: Above 1.
    """
    stolen, ended = Stolen(), threading.Event()

    def each(number: int) -> None:
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)

    def work() -> None:
        # To wake on time among busy processes; without the right to it, turns are less even.
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(threading.get_native_id(), os.SCHED_FIFO, os.sched_param(1))
        ran = PERIOD_S / factor
        while not ended.is_set():
            each(signal.SIGSTOP)
            began = time.perf_counter()
            # By how long it really ran: on a busy machine this thread wakes late.
            ended.wait(ran * (factor - 1))
            each(signal.SIGCONT)
            let_go = time.perf_counter()
            stolen.stops += 1
            stolen.seconds += let_go - began
            ended.wait(PERIOD_S / factor)
            ran = time.perf_counter() - let_go

    thread = threading.Thread(target=work, name="steal", daemon=True)
    if pids:
        thread.start()
    try:
        yield stolen
    finally:
        ended.set()
        if pids:
            thread.join()
        each(signal.SIGCONT)
