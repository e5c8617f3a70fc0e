"""What the client proxy is told so that it can start a manager again that was killed.

One that ended well, because somebody told it to or because its pool is over, is not started again;
nor is one that systemd looks after.

Owns: `manager.json`. Not here: starting it (`fogft.proxy.robot.manager_restart`).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping

from fogft import disk
from fogft.pool.folder.paths import PoolPaths


def allow(paths: PoolPaths, environ: Mapping[str, str] = os.environ) -> None:
    """Say how this process is started, should it die."""
    if environ.get("NOTIFY_SOCKET"):
        forbid(paths)
        return
    value = {
        "command": [sys.executable, *sys.orig_argv[1:]],
        "folder": os.getcwd(),
        "lock": paths.manager_lock.name,
        "changing": paths.intent_lock.name,  # while it is held, somebody may be ending the pool
        "log": paths.manager_log.name,
    }
    disk.write_json(paths.manager_start, value)


def forbid(paths: PoolPaths) -> None:
    """Say that this process shall not be started again."""
    paths.manager_start.unlink(missing_ok=True)
