"""End a process reliably.

Owns: ending by process id. Never by name: only a process that holds one of our locks is ever
signalled.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from fogft import disk

POLL_S = 0.05


def wait_for(condition: Callable[[], bool], limit_s: float) -> bool:
    """Wait for a condition; return whether it came true in time."""
    end = time.monotonic() + limit_s
    while not (found := condition()) and time.monotonic() < end:
        time.sleep(POLL_S)
    return found


def end_holder(lock: Path, *, only: int | None = None, patience_s: float = 10.0) -> int | None:
    """End the process that holds a lock by SIGTERM, then SIGKILL; return its pid.

    Returns when it is gone, not only its lock: a process lets go of what it holds, and may
    hang only then. Another that waited for the lock may hold it by then.

    Args:
        only: End no other process than this one.
        patience_s: How long each signal is given.

    Returns:
        The pid; None if nobody, or another process, holds the lock.
    """
    pid = disk.holder(lock)
    if pid is None or pid == os.getpid() or only not in (None, pid):
        return None
    with _opened(pid) as process:
        for number in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                process.send(number)
                process.send(signal.SIGCONT)  # one that is stopped would never hear of it
            end = time.monotonic() + patience_s
            while process.alive or (disk.is_locked(lock) and disk.holder(lock) in (None, pid)):
                if time.monotonic() > end:
                    break
                time.sleep(POLL_S)
            else:
                break
    return pid


def call_at_end(pid: int, call: Callable[[], None]) -> None:
    """Call a function on its own thread when a process, child or not, has ended.

    At once where it has gone; never where the kernel cannot tell (older than 5.3).
    """

    def wait() -> None:
        with _opened(pid) as process:
            if process.wait():
                call()

    threading.Thread(target=wait, name=f"end-of-{pid}", daemon=True).start()


class _Process:
    """A process that stays this one, even if its number is given to another."""

    def __init__(self, pid: int, descriptor: int | None) -> None:
        self._pid = pid
        self._descriptor = descriptor

    @property
    def alive(self) -> bool:
        """Whether it has not ended; a zombie has. False where the kernel cannot tell."""
        return self._descriptor is not None and not select.select([self._descriptor], [], [], 0)[0]

    def wait(self) -> bool:
        """Wait until it has ended; return whether it has, which an old kernel cannot tell."""
        if self._descriptor is not None:
            ended = select.poll()
            ended.register(self._descriptor, select.POLLIN)
            ended.poll()
        return self._descriptor is not None or not Path("/proc", str(self._pid)).exists()

    def send(self, number: signal.Signals) -> None:
        """Send it a signal."""
        if self._descriptor is None:
            os.kill(self._pid, number)
        else:
            signal.pidfd_send_signal(self._descriptor, number)


@contextlib.contextmanager
def _opened(pid: int) -> Iterator[_Process]:
    try:
        descriptor = os.pidfd_open(pid)
    except OSError:  # it has gone, or the kernel is older than 5.3
        yield _Process(pid, None)
        return
    try:
        yield _Process(pid, descriptor)
    finally:
        os.close(descriptor)
