"""Run the user's command as a child process, and restart it when it exits.

The command runs in its own session and dies with this process, however that ends
(`fogft.child`). It is started through ``bash -c``, as SkyPilot does.
"""

import contextlib
import logging
import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from pathlib import Path

from fogft.child import how_it_ended, tied

log = logging.getLogger(__name__)


@dataclass(eq=False)
class Supervisor:
    """One command, kept running. All methods are called from the main thread only.

    The reason is that the kernel ties the child's life to the *thread* that started it.

    Args:
        command: A shell command; ``exec`` in it saves a process.
        environ: Its whole environment.
        domain_id: Its ROS domain; None to leave it to `environ`.
        stdout: File descriptor for its standard output; None for our own.
    """

    # Backoff between a death and the next start: second and longest wait; the first restart is
    # immediate. A run longer than the longest wait resets it.
    backoff_s = 0.5, 15.0

    command: str
    workdir: Path
    environ: Mapping[str, str]
    _: KW_ONLY
    domain_id: int | None = None
    clock: Callable[[], float] = time.monotonic
    stdout: int | None = None

    def __post_init__(self) -> None:
        if self.domain_id is not None:
            self.environ = {**self.environ, "ROS_DOMAIN_ID": str(self.domain_id)}
        self._wait_s = 0.0  # the first restart is immediate
        self.start_at = 0.0
        self._started_at = 0.0
        self._child: subprocess.Popen[bytes] | None = None
        self.restarts = -1  # since the first start is not a restart
        self.last_exit = ""

    @property
    def alive(self) -> bool:
        """Whether the command is running."""
        return self._child is not None

    def poll(self, *, at_work: bool = False) -> bool:
        """Restart the command when due; return whether it has died since the last call.

        `at_work`: whether it was running requests. If so, one of them is blamed: no backoff.
        """
        died = False
        if self._child is not None:
            status = self._child.poll()
            if status is None:
                return False
            died = True
            self._kill_group(self._child.pid)  # other processes left in its group
            ran_s = self.clock() - self._started_at
            if ran_s > self.backoff_s[1] or at_work:
                self._wait_s = 0.0
            self.last_exit = how_it_ended(status)
            wait_s = self._wait_s
            log.warning("run_ended status=%d ran_s=%.1f again_in_s=%.1f", status, ran_s, wait_s)
            self._child = None
            self._delay_next_start()
        if self.clock() >= self.start_at:
            self._start()
        return died

    def _delay_next_start(self) -> None:
        first_s, longest_s = self.backoff_s
        self.start_at = self.clock() + self._wait_s
        self._wait_s = min(max(2 * self._wait_s, first_s), longest_s)

    def _start(self) -> None:
        self._started_at = self.clock()
        self.restarts += 1
        try:
            self._child = subprocess.Popen(
                tied(["bash", "-c", self.command]),
                cwd=self.workdir,
                env=self.environ,
                stdin=subprocess.DEVNULL,
                stdout=self.stdout,
                start_new_session=True,
            )
        except OSError as error:
            self.last_exit = f"cannot be started: {error}"
            self._delay_next_start()
            log.error("run_not_started reason=%r", str(error))
            return
        log.info("run_started pid=%d command=%r", self._child.pid, self.command)

    def restart(self) -> None:
        """Kill the command; `poll` notices and restarts it."""
        if self._child is not None:
            self._kill_group(self._child.pid)

    def stop(self, grace_s: float = 3.0) -> None:
        """Stop the command: SIGINT as ROS nodes expect, then SIGKILL. Idempotent."""
        child, self._child = self._child, None
        self.start_at = float("inf")
        if child is None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(grace_s)
        self._kill_group(child.pid)
        child.wait()
        log.info("run_stopped")

    @staticmethod
    def _kill_group(pid: int) -> None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(pid, signal.SIGKILL)
