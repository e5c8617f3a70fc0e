"""Find who holds a lock, and end a process for sure.

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
    """Wait until a condition holds; return whether it does in time."""
    end = time.monotonic() + limit_s
    while not (found := condition()) and time.monotonic() < end:
        time.sleep(POLL_S)
    return found


def lock_holder(lock: Path) -> int | None:
    """Return the process that holds a lock; None for nobody.

    By the kernel's own list; in a container, whose overlays that list may know by another device,
    by what the holder wrote.
    """
    try:
        stat = lock.stat()
        lines = Path("/proc/locks").read_text().splitlines()
    except OSError:
        return None
    wanted = f"{os.major(stat.st_dev):02x}:{os.minor(stat.st_dev):02x}:{stat.st_ino}"
    for line in lines:
        fields = line.split()
        if len(fields) >= 6 and fields[1] == "FLOCK" and fields[5] == wanted:
            pid = int(fields[4])
            return pid if pid > 0 else None
    try:
        said = int(lock.read_text())
    except (OSError, ValueError):
        return None
    return said if disk.is_locked(lock) else None


def end_holder(lock: Path, *, patience_s: float = 10.0) -> int | None:
    """End the process that holds a lock: SIGTERM, then SIGKILL. Return its pid; None for nobody.

    Returns when it is gone, not only its lock: a process lets go of what it holds, and may
    hang only then. Another that waited for the lock may hold it by then.
    """
    pid = lock_holder(lock)
    if pid is None or pid == os.getpid():
        return None
    with _opened(pid) as process:
        for number in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                process.send(number)
                process.send(signal.SIGCONT)  # one that is stopped would never hear of it
            end = time.monotonic() + patience_s
            while process.alive or (disk.is_locked(lock) and lock_holder(lock) in (None, pid)):
                if time.monotonic() > end:
                    break
                time.sleep(POLL_S)
            else:
                break
    return pid


def call_at_end(pid: int, call: Callable[[], None]) -> None:
    """Call a function, on a thread of its own, when a process has ended; its parent need not be us.

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
