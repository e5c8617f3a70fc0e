"""A whole pool of real processes, driven only through the command line, as a user would."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from fogft.disk import holder
from fogft.pool.commands import status as seen
from fogft.pool.folder.paths import PoolPaths
from fogft.ros import shared_memory
from tests.fakes.waiting import wait_for
from tests.link import forked

NODES = Path(__file__).parent / "nodes"
_OURS = (sys.executable,)
_PATHS = ("LD_LIBRARY_PATH", "PYTHONPATH")  # who changes them means another fogft, or other types


def run(
    words: Sequence[str],
    environ: Mapping[str, str],
    folder: Path,
    limit_s: float,
    python: Sequence[str] = _OURS,
) -> subprocess.CompletedProcess[str]:
    """Run a command in an environment and a folder, forked from what has imported it if it can."""
    if python is not _OURS or any(environ.get(name) != os.environ.get(name) for name in _PATHS):
        return subprocess.run(
            [*python, "-m", "fogft", *words],
            env=environ, cwd=folder, capture_output=True, text=True, timeout=limit_s, check=False,
        )  # fmt: skip
    with tempfile.TemporaryDirectory() as scratch, tempfile.TemporaryFile("w+") as errors:
        out = Path(scratch, "out")
        given = json.dumps([words, dict(environ), str(folder), str(out)])
        process = forked.Forked("tests.e2e.command", [given], errors.fileno())
        process.stdin.close()
        process.stdout.close()
        try:
            code = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
        errors.seek(0)
        return subprocess.CompletedProcess(words, code, out.read_text(), errors.read())


class Pool:
    """A pool in its own FOGFT_HOME and ROS domain.

    Args:
        folder: Where everything of it lies.
        domain: The robot's ROS domain.
    """

    def __init__(self, folder: Path, domain: int) -> None:
        self.folder = folder
        self.home = folder / "home"
        self.file = folder / "pool.yaml"
        self.environ = {
            **os.environ,
            "FOGFT_HOME": str(self.home),
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "NO_COLOR": "1",
        }
        self.uids: set[str] = set()

    def write(
        self, *, replicas: int = 3, work_s: float = 0.005, more: str = "", task: str = ""
    ) -> None:
        """Write the pool file: `nav_msgs/srv/GetPlan` at `/plan`, answered after `work_s`."""
        self.file.write_text(
            "name: e2e\n"
            "resources:\n"
            "  any_of: [{infra: local/us-west-1}, {infra: local/us-west-2},"
            " {infra: local/eu-central-1}]\n"
            f"run: exec {sys.executable} {NODES}/plan_service.py {work_s}\n"
            f"{task}"
            "fogft:\n"
            f"  replicas: {replicas}\n"
            "  services:\n"
            "    - {name: /plan, type: nav_msgs/srv/GetPlan, timeout_s: 10.0}\n"
            f"{more}"
        )

    def fogft(self, *words: str, ok: bool = True, limit_s: float = 120) -> str:
        """Run a command; return its standard output."""
        done = run(words, self.environ, self.folder, limit_s)
        if ok:
            told = f"exit status {done.returncode}\n{done.stdout}\n{done.stderr}"
            assert done.returncode == 0, f"fogft {' '.join(words)}: {told}"
        return done.stdout if ok else done.stdout + done.stderr

    def paths(self) -> PoolPaths:
        """Return where the only pool here lies."""
        [folder] = (self.home / "pools").iterdir()
        return PoolPaths(folder)

    def status(self) -> dict[str, Any]:
        """Return what `fogft status --json` says, without a process: tests look often."""
        status = seen.read(self.paths(), time.time()).to_json()
        self.uids.add(status["uid"])
        return status

    def ready(self) -> int:
        """Count the replicas that are ready."""
        return sum(1 for r in self.status()["replicas"] if r["phase"] == "ready")

    def wait(self, condition: Callable[[], Any], limit_s: float = 90) -> Any:
        """Wait until a condition holds; return what it gave."""
        return wait_for(condition, limit_s, told=self.status, pause_s=0.2)

    def up(self, *words: str) -> None:
        """Start or change the pool and wait until it is whole."""
        self.fogft("up", str(self.file), "--yes", *words)
        wanted = self.status()["target"]
        self.wait(lambda: self.ready() == wanted)

    def robot_side(self) -> list[int]:
        """Return the processes of the robot's side: the manager and the client proxies."""
        paths = self.paths()
        waiting = [
            self.wait(lambda: holder(lock))  # noqa: B023
            for lock in (paths.standby_lock, paths.spare_lock)
        ]
        manager, proxy = holder(paths.manager_lock), self.status()["proxy_pid"]
        assert manager is not None
        return [manager, proxy, *waiting]

    def kill_robot_side(self) -> None:
        """Kill all of it; none has the time to start another."""
        all_of_it = self.robot_side()
        for number in (signal.SIGSTOP, signal.SIGKILL):
            for pid in all_of_it:
                os.kill(pid, number)

    def client(self, seconds: float, rate_hz: float, limit_s: float = 12.0) -> Client:
        """Start an ordinary rclpy client that asks for a while."""
        return Client(self.environ, seconds, rate_hz, limit_s)

    def processes(self) -> list[int]:
        """Find the processes of this pool by what they carry in their environment."""
        home = self.environ["FOGFT_HOME"].encode()
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit() and int(entry.name) != os.getpid():
                try:
                    if home in (entry / "environ").read_bytes():
                        found.append(int(entry.name))
                except OSError:
                    continue
        return found

    def left(self) -> dict[int, str]:
        """Return the command of each process of this pool, by process id."""
        found = {}
        for pid in self.processes():
            try:
                found[pid] = Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")
            except OSError:
                continue
        return found

    def close(self) -> None:
        """End what is left of the pool by force, which takes seconds less than `fogft down`."""
        while left := self.processes():  # the manager and the proxy start each other
            for pid in left:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        shared_memory.sweep()


class Machine:
    """Another machine of a pool: a home and a ROS domain of its own, set up by `fogft join`.

    Args:
        pool: Whose.
        role: Of the bundle that is issued for it.
        name: Of its holder.
        domain: Its ROS domain; None for the pool's.
        python: The command that starts its Python.
    """

    def __init__(
        self,
        pool: Pool,
        role: str,
        name: str,
        domain: int | None = None,
        python: Sequence[str] = _OURS,
    ) -> None:
        self._fogft = [*python, "-m", "fogft"]
        self.environ = {**pool.environ, "FOGFT_HOME": str(pool.folder / name)}
        if domain is not None:
            self.environ["ROS_DOMAIN_ID"] = str(domain)
        self._folder = pool.folder
        secret = pool.folder / "secret"
        secret.write_text("a passphrase that unknown\n")
        given = ("--passphrase-file", str(secret))
        bundle = pool.fogft("credentials", "issue", role, name, *given).strip()
        joined = run(("join", bundle, *given), self.environ, pool.folder, 120, python)
        assert joined.returncode == 0, joined.stderr
        self.config = Path(joined.stdout.strip())
        self.command = {"robot": "proxy", "replica": "serve"}.get(role, role)
        self.log = self.config.with_suffix(".log")
        self.process: subprocess.Popen[bytes] | None = None

    def configure(self, **values: str) -> None:
        """Set keys of its configuration."""
        config = {**yaml.safe_load(self.config.read_text()), **values}
        self.config.write_text(yaml.safe_dump(config))

    def start(self) -> None:
        """Start what the bundle was for."""
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [*self._fogft, self.command, "--config", str(self.config)],
                env=self.environ, cwd=self._folder, stdout=log, stderr=log,
            )  # fmt: skip

    def report(self) -> dict[str, Any]:
        """Return what it reports; nothing before it does."""
        with contextlib.suppress(OSError, ValueError):
            return dict(json.loads((self.config.parent / "proxy-status.json").read_text()))
        return {}

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()


class Client:
    """A running plan_client.py."""

    def __init__(
        self, environ: dict[str, str], seconds: float, rate: float, limit_s: float, *file: str
    ):
        self._seconds = seconds + limit_s
        given = (str(seconds), str(rate), str(limit_s), *file)
        self._process = subprocess.Popen(
            [sys.executable, f"{NODES}/plan_client.py", *given],
            env=environ, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if line.startswith("asking"):
                break

    @property
    def asking(self) -> bool:
        return self._process.poll() is None

    def kill(self) -> None:
        self._process.kill()
        self._process.communicate()

    def finish(self) -> dict[str, Any]:
        """Let it ask no more; return its summary once all is answered or given up."""
        if self.asking:
            self._process.send_signal(signal.SIGINT)
        return self.result()

    def result(self) -> dict[str, Any]:
        """Wait for its end and return its summary."""
        out, err = self._process.communicate(timeout=self._seconds + 30)
        assert self._process.returncode == 0, err
        return json.loads(out)
