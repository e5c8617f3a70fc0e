"""Keep the client proxy running: adopt the one that runs, start one where there is none.

Its death is no reason to touch a replica, and its life needs no manager: it is started in
a session of its own and lives on when the manager goes.

Owns: starting it again, with backoff.
Not here: its configuration (`configuration`).
"""

from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Callable, Sequence

from fogft import disk
from fogft.child import detached
from fogft.model.reason import Cause, Reason
from fogft.pool.folder.paths import PoolPaths

log = logging.getLogger(__name__)

BACKOFF_S = 1.0
BACKOFF_LIMIT_S = 30.0
STEADY_S = 30.0  # one that ran so long earns a quick restart


class ProxySupervisor:
    """Looks after one client proxy; `look` is called with each tick.

    Args:
        paths: The pool's folder.
        clock: Monotonic seconds.
        command: What to start; ``python -m fogft proxy --config ...`` unless told.
    """

    def __init__(
        self,
        paths: PoolPaths,
        clock: Callable[[], float],
        command: Sequence[str] | None = None,
    ) -> None:
        self._paths = paths
        self._clock = clock
        self._command = command or (
            *(sys.executable, "-m", "fogft"),
            *("proxy", "--config", str(paths.proxy_config)),
        )
        self.child: subprocess.Popen[bytes] | None = None
        self._started_at = 0.0
        self._next_at = 0.0
        self._failures = 0

    def look(self) -> bool:
        """Start the proxy where it is missing; return whether one runs."""
        if self.child is not None:
            if self.child.poll() is None:
                return True
            self._ended(self.child.returncode)
            self.child = None
        # Only asked when none of ours runs: asking takes the lock for a moment.
        if disk.is_locked(self._paths.proxy_lock):
            return True
        if self._clock() < self._next_at:
            return False
        self._started_at = self._clock()
        self.child = detached(self._command, self._paths.proxy_log)
        log.info("proxy_started pid=%d", self.child.pid)
        return True

    def _ended(self, status: int) -> None:
        ran_s = self._clock() - self._started_at
        self._failures = 1 if ran_s > STEADY_S else self._failures + 1
        wait_s = min(BACKOFF_S * 2.0 ** min(self._failures - 1, 16), BACKOFF_LIMIT_S)
        self._next_at = self._clock() + (0.0 if ran_s > STEADY_S else wait_s)
        log.warning("proxy_ended status=%d ran_s=%.1f", status, ran_s)

    @property
    def trouble(self) -> Reason | None:
        """Return what is wrong with it; None when nothing is."""
        if self._failures < 2 or self.child is not None:
            return None
        log_name = str(self._paths.proxy_log)
        return Reason(Cause.PROXY_KEEPS_ENDING, count=self._failures, name=log_name)
