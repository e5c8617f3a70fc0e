"""Keep a client proxy, its standby and a spare running; they keep running when the manager ends.

The next in line takes over by itself, and a spare that moves up leaves a new one behind it
(`proxy.robot.standby`). Here, a missing end of the line is started, and running ones are adopted.

Owns: killing hung proxies, and `manager.json` (`fogft.proxy.robot.manager_restart`).
Not here: its configuration (`configuration`).
"""

import contextlib
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fogft import disk
from fogft.child import detached, how_it_ended, python
from fogft.model.reason import Cause, Reason
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.manager import process_control
from fogft.process import Hanging

log = logging.getLogger(__name__)

BACKOFF_S = 1.0
BACKOFF_LIMIT_S = 30.0
STEADY_S = 5.0  # a proxy that ran this long did not fail
HANGS_AFTER_S = 10.0
START_LIMIT_S = 20.0  # a proxy without a place in line by then gets none
MOVING_UP_S = 1.0  # how long the line may be short while others run


@dataclass(eq=False)
class ProxySupervisor:
    """Supervises a pool's client proxies; `look` is called in each tick.

    Args:
        command: A single process to start; by default a line of ``python -m fogft proxy ...``.
        ended: Called, from any thread, when a proxy has ended: then `look` is due at once.
    """

    paths: PoolPaths
    clock: Callable[[], float]
    command: Sequence[str] | None = None
    ended: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        self._command = self.command or (
            *python("-m", "fogft"),
            *("proxy", "--spare", "--config", str(self.paths.proxy_config)),
        )
        self._children: dict[subprocess.Popen[bytes], float] = {}  # and when each was started
        self._watched: set[int] = set()
        self._ending: set[int] = set()
        locks = self.paths.proxy_lock, self.paths.standby_lock, self.paths.spare_lock
        self._hanging = {lock: Hanging(HANGS_AFTER_S, self.clock) for lock in locks}
        self._places = locks if self.command is None else locks[:1]
        self._sessions: set[int] = set()  # of started proxies and their copies
        self._complete_at = float("-inf")
        self._next_at = 0.0
        self._failures = 0
        self._last_end = ""
        self._serving = 0
        self.replacements = 0  # how often the serving proxy was seen to change

    def look(self, *, outdated: bool = False) -> bool:
        """Start missing proxies, and replace those of another version; return whether one works."""
        now = self.clock()
        for child in [one for one in self._children if one.poll() is not None]:
            started_at = self._children.pop(child)
            self._ended(child.returncode, now - started_at)
        for lock, hanging in self._hanging.items():
            pid = disk.holder(lock, said=False)
            if hanging.end(pid):
                log.error("proxy_hangs pid=%d", pid)
        line = [self._holder(lock) for lock in self._places]
        serving = line[0]
        if serving and serving != self._serving:
            self.replacements += self._serving != 0
            self._serving = serving
        if outdated:
            self._end_outdated(line)
        for child, started_at in self._children.items():
            if child.pid not in line and now - started_at < START_LIMIT_S:
                return True
        running = any(pid is not None for pid in line)
        if line[-1] is not None:
            self._complete_at = now
        moving_up = running and now - self._complete_at <= MOVING_UP_S
        if line[-1] is not None or moving_up or now < self._next_at:
            return running
        process = detached(self._command, self.paths.proxy_log)
        self._children[process] = now
        self._sessions.add(process.pid)
        self._watch(process.pid)
        log.info("proxy_started pid=%d others=%s", process.pid, running)
        return True

    def _end_outdated(self, line: Sequence[int | None]) -> None:
        """End the last proxy in line that is not ours; others only once one of ours is behind."""
        for pid in reversed(line):
            if not pid:
                return
            with contextlib.suppress(ProcessLookupError):
                if os.getsid(pid) in self._sessions:
                    continue
                if pid not in self._ending:
                    self._ending.add(pid)
                    log.info("proxy_outdated pid=%d", pid)
                    os.kill(pid, signal.SIGTERM)
            return

    def _holder(self, lock: Path) -> int | None:
        """Return the pid that holds a lock, 0 if unknown, None for nobody; watch for its end."""
        pid = disk.holder(lock)
        if pid is None:
            return 0 if disk.is_locked(lock) else None
        self._watch(pid)
        return pid

    def _watch(self, pid: int) -> None:
        def gone() -> None:
            self._watched.discard(pid)
            self._ending.discard(pid)
            self.ended()

        if pid not in self._watched:
            self._watched.add(pid)
            process_control.call_at_end(pid, gone)

    def _ended(self, status: int, ran_s: float) -> None:
        self._failures = 0 if ran_s > STEADY_S else self._failures + 1
        self._last_end = how_it_ended(status)
        log.warning("proxy_ended status=%d ran_s=%.1f", status, ran_s)
        if self._failures > 1:
            wait_s = min(BACKOFF_S * 2.0 ** min(self._failures - 2, 16), BACKOFF_LIMIT_S)
            self._next_at = self.clock() + wait_s

    @property
    def trouble(self) -> Reason | None:
        """Return the problem with the client proxy; None without one."""
        if self._failures < 2 or self._children:
            return None
        return Reason(
            Cause.PROXY_KEEPS_ENDING,
            count=self._failures,
            name=str(self.paths.proxy_log),
            words=self._last_end,
        )


def allow_restart(paths: PoolPaths, environ: Mapping[str, str] = os.environ) -> None:
    """Record how to restart this process if it dies; under systemd, that it must not be."""
    if environ.get("NOTIFY_SOCKET"):
        forbid_restart(paths)
        return
    value = {
        "command": [sys.executable, *sys.orig_argv[1:]],
        "folder": os.getcwd(),
        "lock": paths.manager_lock.name,
        "changing": paths.intent_lock.name,  # while it is held, a command may be ending the pool
        "log": paths.manager_log.name,
    }
    disk.write_json(paths.manager_start, value)


def forbid_restart(paths: PoolPaths) -> None:
    """Record that this process must not be restarted."""
    paths.manager_start.unlink(missing_ok=True)
