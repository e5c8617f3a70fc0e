"""Restart the pool's manager if it was killed or hangs. The manager's file says how to start it."""

import logging
import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from fogft import disk
from fogft.child import detached
from fogft.errors import StateError
from fogft.process import Hanging

log = logging.getLogger(__name__)

NAME = "manager.json"
LOOK_S = 1.0
BACKOFF_LIMIT_S = 60.0
STEADY_S = 60.0
HANGS_AFTER_S = 120.0  # it may be waiting for the cloud


@dataclass(eq=False)
class ManagerRestart:
    """Watches the manager of a pool's folder: kills it if it hangs, restarts it if it is gone.

    `environ` is for the manager: our own environment before ROS was prepared in it.
    """

    folder: Path
    environ: Mapping[str, str]
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._environ = dict(self.environ)
        self._look_at = 0.0
        self._started_at = float("-inf")
        self._wait_s = LOOK_S
        self._missing = False
        self._lock = self.folder
        self._hanging = Hanging(HANGS_AFTER_S, self.clock)
        self.child: subprocess.Popen[bytes] | None = None

    def look(self) -> None:
        """Restart the manager if it has been missing for a while, with exponential backoff.

        Raises StateError: It cannot be started, or its file is damaged.
        """
        now = self.clock()
        if now < self._look_at:
            return
        self._look_at = now + LOOK_S
        told = disk.read_json(self.folder / NAME)
        if told is None or (self.child is not None and self.child.poll() is None):
            self._missing = False
            return
        try:
            locks = [self.folder / str(told[key]) for key in ("lock", "changing")]
            command, folder = [str(word) for word in told["command"]], Path(told["folder"])
            log_path = self.folder / str(told["log"])
        except (TypeError, KeyError) as error:
            raise StateError(f"`{self.folder / NAME}` is damaged: {error!r}") from error
        self._lock = locks[0]
        holder = disk.holder(self._lock, said=False)
        if self._hanging.end(holder):
            log.error("manager_hangs pid=%d", holder)
        missing = not any(map(disk.is_locked, locks))
        if missing and self._missing:  # twice in a row: not just between two commands
            self._start(command, folder, log_path)
        self._missing = missing

    def _start(self, command: list[str], folder: Path, log_path: Path) -> None:
        now = self.clock()
        ran_s = now - self._started_at
        self._wait_s = LOOK_S if ran_s > STEADY_S else min(2 * self._wait_s, BACKOFF_LIMIT_S)
        self._look_at, self._started_at = now + self._wait_s, now
        try:
            here = folder if folder.is_dir() else self.folder  # where `up` ran, if it still exists
            self.child = detached(command, log_path, folder=here, environ=self._environ)
        except OSError as error:
            raise StateError(f"the manager cannot be restarted: {error}") from error
        log.warning("manager_started_again pid=%d", self.child.pid)

    def close(self) -> None:
        """Kill a restarted manager that has no lock yet: the pool may be shutting down."""
        child = self.child
        if child is not None and child.poll() is None and not disk.is_locked(self._lock):
            child.kill()
            child.wait()
