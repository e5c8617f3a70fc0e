"""How each of fogft's processes starts: its log, and the signals that end it."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping

ENDING_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


def start_log() -> None:
    """Log to standard error, one line each; lines of libraries from warnings on."""
    logging.basicConfig(
        stream=sys.stderr,
        level=logging.WARNING,
        format="%(asctime)s.%(msecs)03d %(levelname)s %(message)s",
        datefmt="%Y-%m-%dT%H:%M:%S",
        force=True,
    )
    logging.getLogger("fogft").setLevel(logging.INFO)


def notify(state: str, environ: Mapping[str, str] = os.environ) -> None:
    """Tell systemd something (sd_notify), where it has started this process; else do nothing."""
    address = environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return
    if address.startswith("@"):
        address = "\0" + address[1:]
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told:
        told.sendto(state.encode(), address)


class Watchdog:
    """Tells systemd that this process works, as often as its unit's WatchdogSec asks for."""

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        environ: Mapping[str, str] = os.environ,
    ) -> None:
        self._clock = clock
        self._environ = environ
        written = environ.get("WATCHDOG_USEC", "")
        self._every_s = int(written) / 4e6 if written.isdigit() and int(written) else None
        self._next_at = float("-inf")

    def work(self) -> None:
        """Say so if it is time; to be called in each round of the process's main loop."""
        if self._every_s is not None and self._clock() >= self._next_at:
            self._next_at = self._clock() + self._every_s
            notify("WATCHDOG=1", self._environ)


def stop_on_signal() -> threading.Event:
    """Return an event that SIGTERM, SIGINT and SIGHUP set."""
    stop = threading.Event()
    for number in ENDING_SIGNALS:
        signal.signal(number, lambda *_: stop.set())
    return stop
