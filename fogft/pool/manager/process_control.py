"""End a process reliably.

Owns: ending by process id. Never by name: only a process that holds one of our locks is ever
signalled.
"""

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from fogft import disk, poll
from fogft.process import on_thread

POLL_S = 0.05


def wait_for(condition: Callable[[], bool], limit_s: float) -> bool:
    """Wait for a condition; return whether it came true in time."""
    end = time.monotonic() + limit_s
    while not (found := condition()) and time.monotonic() < end:
        time.sleep(POLL_S)
    return found


def end_holder(lock: Path, *, only: int | None = None, patience_s: float = 10.0) -> int | None:
    """End the process that holds a lock by SIGTERM, then SIGKILL; return its pid, or None.

    Returns when the process is gone, not only its lock: it may release the lock and then hang.
    By then, a process that waited for the lock may hold it. `only` is the one process that may be
    ended; each signal gets `patience_s`.
    """
    pid = disk.holder(lock)
    if pid is None or pid == os.getpid() or only not in (None, pid):
        return None
    with _opened(pid) as descriptor:

        def gone() -> bool:
            if descriptor is not None and not poll.is_ready(descriptor):
                return False  # still running; a zombie is not
            return not disk.is_locked(lock) or disk.holder(lock) not in (None, pid)

        for number in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                _send(pid, descriptor, number)
                _send(pid, descriptor, signal.SIGCONT)  # a stopped process would not handle it
            if wait_for(gone, patience_s):
                break
    return pid


def call_at_end(pid: int, call: Callable[[], None]) -> None:
    """Call a function on its own thread when a process, child or not, has ended.

    At once if it is gone already; never if the kernel cannot tell (older than 5.3).
    """

    def wait() -> None:
        with _opened(pid) as descriptor:
            if descriptor is not None:
                poll.is_ready(descriptor, None)
            elif Path("/proc", str(pid)).exists():
                return
            call()

    on_thread(wait, name=f"end-of-{pid}")


def _send(pid: int, descriptor: int | None, number: signal.Signals) -> None:
    if descriptor is None:
        os.kill(pid, number)
    else:
        signal.pidfd_send_signal(descriptor, number)


@contextlib.contextmanager
def _opened(pid: int) -> Iterator[int | None]:
    """Yield a pidfd, which stays with this process even if its pid is reused; None if unknown."""
    try:
        descriptor = os.pidfd_open(pid)
    except (OSError, AttributeError):  # it is gone, or pidfds are not supported
        yield None
        return
    try:
        yield descriptor
    finally:
        os.close(descriptor)
