"""Pools of real processes for an experiment, driven through the command line as a user would.

Owns: a `FOGFT_HOME` and a ROS domain of its own, waiting for pools, ending all of it.
Not here: asking the services (`caller`).
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from fogft import disk
from fogft.cloud.local import processes
from fogft.poolfile import file as pool_file
from fogft.ros import shared_memory
from tests.bench.rig import ROOT, free_domains
from tests.evaluation.errors import EvaluationError

T = TypeVar("T")
WAIT_S = 180.0


class Pools:
    """Pools in one `FOGFT_HOME`, whose services appear in one ROS domain.

    Args:
        folder: Where everything of them lies.

    Attributes:
        domain: The robot's ROS domain.
        home: The `FOGFT_HOME`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.home = folder / "home"
        (self.domain,) = free_domains(1)
        self._environ = {k: v for k, v in os.environ.items() if not k.startswith("FOGFT_")}
        self._environ.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
        self._environ.update(
            FOGFT_HOME=str(self.home),
            ROS_DOMAIN_ID=str(self.domain),
            ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST",
            ROS_LOG_DIR=str(folder / "ros-log"),
            PYTHONPATH=os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])),
            NO_COLOR="1",
        )

    @property
    def environ(self) -> dict[str, str]:
        """Return the environment of everything that shall see these pools."""
        return dict(self._environ)

    def regions(self, text: str) -> None:
        """Replace the local cloud's catalogue (docs/design/local-cloud.md has its keys)."""
        path = self.home / "local" / "regions.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def fogft(self, *words: str, limit_s: float = 300.0) -> str:
        """Run a command; return what it wrote to standard output.

        Raises:
            EvaluationError: It failed, or took longer than `limit_s`.
        """
        try:
            done = subprocess.run(
                [sys.executable, "-m", "fogft", *words],
                env=self._environ, cwd=self.folder, capture_output=True, text=True,
                timeout=limit_s, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise EvaluationError(f"`fogft {' '.join(words)}` took over {limit_s:g} s") from None
        if done.returncode:
            raise EvaluationError(f"`fogft {' '.join(words)}` failed:\n{done.stderr.strip()}")
        return done.stdout

    def init(self, template: str, into: str | None = None) -> Path:
        """Write an example's files as a user does; return their folder."""
        folder = self.folder / (into or template)
        self.fogft("init", template, "--into", str(folder))
        return folder

    def up(self, *files: Path, whole: bool = True) -> None:
        """Start pools side by side, or change them to what their files say; wait until all
        their replicas are ready."""
        with ThreadPoolExecutor(len(files)) as threads:
            list(threads.map(lambda file: self.fogft("up", str(file), "--yes"), files))
        for file in files if whole else ():
            self.wait_whole(pool_file.read(file).name)

    def wait_whole(self, pool: str) -> None:
        """Wait until as many replicas are ready and linked as the pool wants."""
        self.wait(
            lambda: (s := self.status(pool)) and len(self.ready(pool)) >= s["target"],
            f"pool {pool} to be whole",
        )

    def status(self, pool: str) -> dict[str, Any]:
        """Return what `fogft status --json` would print, without the cost of a process."""
        return disk.read_json(self.home / "pools" / pool / "status.json") or {}

    def ready(self, pool: str) -> list[dict[str, Any]]:
        """Return the replicas that are ready and whose link is up, as `status` tells them."""
        return [
            r
            for r in self.status(pool).get("replicas", ())
            if (r["phase"], r["verdict"], r["link"]) == ("ready", "good", "up")
        ]

    def wait(self, condition: Callable[[], T], what: str, limit_s: float = WAIT_S) -> T:
        """Wait until a condition holds; return what it gave.

        Raises:
            EvaluationError: It does not hold within `limit_s`.
        """
        end = time.monotonic() + limit_s
        while not (value := condition()):
            if time.monotonic() > end:
                raise EvaluationError(
                    f"waited {limit_s:g} s in vain for {what}\n{self._last_words()}"
                )
            time.sleep(0.05)
        return value

    def service_pids(self, pool: str, slot: int, program: str) -> list[int]:
        """Return the processes on a replica's machine whose command line has `program` in it."""
        status = self.status(pool)
        # Beside a new one its predecessor may still be ending.
        generation = max(r["generation"] for r in status["replicas"] if r["slot"] == slot)
        found = []
        for pid in processes.find(machine=f"{status['uid']}-{slot}.{generation}"):
            with contextlib.suppress(OSError):
                words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
                if any(word.endswith(program.encode()) for word in words):
                    found.append(pid)
        return found

    def close(self) -> None:
        """End all pools through the command line, and what is left of them by force."""
        names = [path.name for path in self.home.glob("pools/*") if path.is_dir()]
        uids = [uid for name in names if (uid := self.status(name).get("uid"))]
        with ThreadPoolExecutor(max(1, len(names))) as threads:
            list(threads.map(self._down, names))
        for uid in uids:
            processes.end(processes.find(pool_uid=uid))
        shared_memory.sweep()

    def _down(self, name: str) -> None:
        with contextlib.suppress(EvaluationError):  # what it leaves is ended by force
            self.fogft("down", name, "--yes")

    def _last_words(self) -> str:
        lines = []
        for log in sorted(self.home.glob("**/*.log")):
            lines += [f"{log.name}: {line}" for line in log.read_text().splitlines()[-3:]]
        return "\n".join(lines[-30:])
