"""What both proxies need of their process: a log, signals, and files watched for change."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from pathlib import Path


def start_log(level: str = "info") -> None:
    """Log to standard error: time, level, event and its keys, one line each."""
    logging.basicConfig(
        stream=sys.stderr,
        level=level.upper(),
        format="%(asctime)s.%(msecs)03d %(levelname)s %(message)s",
        datefmt="%Y-%m-%dT%H:%M:%S",
        force=True,
    )


def stop_on_signal() -> threading.Event:
    """Return an event that SIGTERM, SIGINT and SIGHUP set."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: stop.set())
    return stop


class Watched:
    """A file that is replaced whole: tells when it became another one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._seen: tuple[int, int, int] | None = None

    def changed(self) -> bool:
        """Return whether the file is there and is not the one seen at the last call."""
        try:
            stat = os.stat(self.path)
        except OSError:
            return False
        mark = (stat.st_mtime_ns, stat.st_ino, stat.st_size)
        if mark == self._seen:
            return False
        self._seen = mark
        return True
