"""Used by all processes of fogft: logging, signals, systemd notification, faster start-up."""

import contextlib
import gc
import importlib
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from fogft.errors import NoThread

_STEP_S = 2.0


def start_log() -> None:
    """Log to standard error, one line per record, in UTC; from libraries, warnings and above."""
    logging.Formatter.converter = time.gmtime
    logging.basicConfig(
        stream=sys.stderr,
        level=logging.WARNING,
        format="%(asctime)s.%(msecs)03d %(levelname)s %(message)s",
        datefmt="%Y-%m-%dT%H:%M:%S",
        force=True,
    )
    logging.getLogger("fogft").setLevel(logging.INFO)


def notify(state: str) -> None:
    """Notify systemd (sd_notify) if it started this process; else do nothing."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return
    if address.startswith("@"):
        address = "\0" + address[1:]
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told:
        told.sendto(state.encode(), address)


class Watchdog:
    """Notifies systemd's watchdog as often as the unit's WatchdogSec requires."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        written = os.environ.get("WATCHDOG_USEC", "")
        self._every_s = int(written) / 4e6 if written.isdecimal() and int(written) else None
        self._next_at = float("-inf")

    def work(self) -> None:
        """Notify if it is time; call it in each round of the main loop."""
        if self._every_s is not None and self._clock() >= self._next_at:
            self._next_at = self._clock() + self._every_s
            notify("WATCHDOG=1")


class Hanging:
    """Detects a hung process: one that is stopped, or whose main loop makes no progress.

    It hangs if the kernel's count of its main thread's sleeps is the same for `limit_s`. A longer
    gap between two looks counts as 2 s: this process, and the other, may have been asleep.
    """

    def __init__(self, limit_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._limit_s = limit_s
        self._clock = clock
        self._seen: tuple[int | None, str] = (None, "")
        self._still_s = 0.0
        self._looked_at = clock()

    def look(self, pid: int | None) -> bool:
        """Look at a process, the same as before or another one; return whether it hangs."""
        seen, now = (pid, _sleeps(pid)), self._clock()
        step_s = min(now - self._looked_at, _STEP_S)
        self._still_s = self._still_s + step_s if seen[1] and seen == self._seen else 0.0
        self._looked_at, self._seen = now, seen
        return self._still_s > self._limit_s

    def end(self, pid: int | None) -> bool:
        """Look at a process; kill it if it hangs, and return whether it did."""
        if not self.look(pid) or pid is None:
            return False
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        return True


def _sleeps(pid: int | None) -> str:
    with contextlib.suppress(OSError), open(f"/proc/{pid}/status") as file:
        return next((line for line in file if line.startswith("voluntary_ctxt")), "")
    return ""


def on_thread(run: Callable[..., object], *arguments: Any, name: str = "") -> threading.Thread:
    """Start a daemon thread. Raises NoThread."""
    thread = threading.Thread(target=run, args=arguments, name=name or None, daemon=True)
    try:
        thread.start()
    except RuntimeError as error:
        raise NoThread(f"{error}: check `ulimit -u`, TasksMax and the free memory") from error
    return thread


def prepared_thread(run: Callable[[], object]) -> Callable[[], None]:
    """Start a daemon thread that waits; return what lets it run. Raises as `on_thread` does."""
    begins = threading.Event()
    on_thread(lambda: begins.wait() and run())
    return begins.set


def ending_signals() -> list[signal.Signals]:
    """Return the signals that end this process: SIGTERM, SIGINT and, except under nohup, SIGHUP."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [signal.SIGTERM, signal.SIGINT, *([] if ignored else [signal.SIGHUP])]


def stop_on_signal() -> threading.Event:
    """Return an event that `ending_signals` set."""
    stop = threading.Event()
    for number in ending_signals():
        signal.signal(number, lambda *_: stop.set())
    return stop


class Wakeup:
    """Wakes a waiting thread, also from a signal handler.

    Not an Event: a handler may interrupt the thread that holds its lock. Not a queue: before Python
    3.13, `get` waits for ever if a signal is handled just as its timeout ends.
    """

    def __init__(self) -> None:
        self._asleep = threading.Lock()
        self._asleep.acquire()

    def wake(self) -> None:
        """End the current wait, or the next one. Any thread, or a signal handler."""
        try:  # noqa: SIM105 - on the request path, where a context manager costs thrice as much
            self._asleep.release()
        except RuntimeError:
            pass  # already woken

    def wait(self, timeout_s: float) -> bool:
        """Wait to be woken, for at most `timeout_s`; return whether it was. One thread."""
        return self._asleep.acquire(timeout=timeout_s)


_THREADS = "OPENBLAS_NUM_THREADS"


def load_numpy() -> None:
    """Import numpy, if installed, with a single BLAS thread, unless the user set their number.

    ROS types import it, and OpenBLAS's threads spin before they sleep: 30 to 100 ms of start-up.
    """
    if _THREADS in os.environ:
        return
    os.environ[_THREADS] = "1"  # OpenBLAS reads it when loaded
    try:
        with contextlib.suppress(Exception):  # the next import of it reports the error
            importlib.import_module("numpy")
    finally:
        del os.environ[_THREADS]  # the user's command may want BLAS


def begin_start() -> None:
    """Disable garbage collection until `end_start`: objects made at start-up live on."""
    gc.disable()


def end_start() -> None:
    """Re-enable garbage collection, and freeze the objects that exist now."""
    gc.freeze()
    gc.enable()
