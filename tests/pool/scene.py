"""A pool in a temporary home, over the folder cloud, with managers as real processes."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from fogft import disk
from fogft.pool.commands import startup
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import Identity, PoolStore, write_identity
from fogft.pool.manager import shutdown
from fogft.poolfile import file as pool_file
from tests.fakes.waiting import wait_for
from tests.link import forked
from tests.pool.folder_cloud import FolderCloud

MANAGER = "tests.pool.manager.manager_process"
FILE = """\
name: pool
run: exec ./serve
fogft:
  replicas: {replicas}
  max_hours: {max_hours}
  services:
    - {{name: /plan, type: nav_msgs/srv/GetPlan, timeout_s: {timeout_s}}}
"""


def store_of(home: Path, name: str = "pool") -> PoolStore:
    return PoolStore(
        PoolPaths.of(name, home), lambda text, file: pool_file.parse(text, file=file), time.time
    )


def cloud_of(home: Path) -> FolderCloud:
    return FolderCloud(home / "cloud")


class Scene:
    """What a test of whole processes needs; `close` ends every process it started."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.file = home / "pool.yaml"
        self.store = store_of(home)
        self.paths = self.store.paths
        self.cloud = cloud_of(home)
        self.started: list[forked.Forked] = []

    def write(
        self, *, replicas: int = 2, timeout_s: float = 5.0, max_hours: float = 100.0
    ) -> Identity:
        """Do what `up` does with files."""
        source = FILE.format(replicas=replicas, timeout_s=timeout_s, max_hours=max_hours)
        self.file.write_text(source)
        spec = pool_file.read(self.file)
        startup.write(self.store, spec, source=source, file=self.file, cloud="folder")
        return self.store.identity()

    def command(self, name: str = "pool") -> list[str]:
        return [sys.executable, "-m", MANAGER, str(self.home), name]

    def let_hours_pass(self, hours: float) -> None:
        """Make the pool older than it is."""
        identity = self.store.identity()
        older = replace(identity, created_at=identity.created_at - hours * 3600)
        write_identity(self.paths, older)

    def start_manager(self) -> forked.Forked:
        """Start a manager; it need not get into office."""
        self.home.mkdir(exist_ok=True)
        with (self.home / "manager-output").open("ab") as output:
            process = forked.Forked(MANAGER, [str(self.home), "pool"], output.fileno())
        process.stdin.close()
        process.stdout.close()
        self.started.append(process)
        return process

    def status(self) -> dict[str, Any]:
        return disk.read_json(self.paths.status) or {}

    def running(self) -> list[str]:
        """Return the machines that exist."""
        return [m.id.short for m in self.cloud.machines(self.store.identity().uid)]

    def wait(self, condition: Callable[[], Any], limit_s: float = 30.0) -> Any:
        """Wait until a condition holds; return what it gave."""
        return wait_for(
            condition, limit_s, told=lambda: (self.status(), self.output()), pause_s=0.02
        )

    def whole(self, count: int) -> bool:
        """Whether the manager sees so many ready replicas and no others."""
        seen = self.status()
        return seen.get("ready") == count and len(seen["replicas"]) == count

    def end(self, warned: list[str] | None = None) -> list[str]:
        """Do what `down` does."""
        ended: list[str] = []
        warnings = [] if warned is None else warned
        shutdown.end(
            self.store,
            lambda _: self.cloud,
            told=ended.append,
            warned=warnings.append,
            limit_s=5,
        )
        return ended

    def output(self) -> str:
        path = self.home / "manager-output"
        return path.read_text() if path.exists() else ""

    def close(self) -> None:
        for process in self.started:
            if process.poll() is None:
                process.kill()
            process.wait()
        pid = disk.holder(self.paths.proxy_lock)
        if pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
