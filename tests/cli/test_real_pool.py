"""The commands on a pool of real processes, from `init` to `down`, in one go."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from fogft.cloud.local import processes
from fogft.pool.commands import composition
from fogft.pool.commands.status import read
from tests.cli.pools import lay_down

pytestmark = [pytest.mark.e2e, pytest.mark.ros, pytest.mark.timeout(400)]
LIMIT_S = 120.0  # the machine may be busy with other tests


@pytest.fixture
def fogft(home: Path, ros_domain: int, monkeypatch: pytest.MonkeyPatch):
    """Return a function that runs ``fogft`` as a process; every pool is ended at the end."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")

    def run(*arguments: str, status: int = 0) -> subprocess.CompletedProcess[str]:
        ended = subprocess.run(
            [sys.executable, "-m", "fogft", *arguments], capture_output=True, text=True, check=False
        )
        assert ended.returncode == status, ended.stderr
        return ended

    yield run
    for pool in (home / "pools").glob("*"):
        run("down", pool.name)


def wait_for(look: Callable[[], dict], good: Callable[[dict], bool]) -> dict:
    """Return the first status that is good."""
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        status = look()
        if good(status):
            return status
        time.sleep(0.2)
    pytest.fail(f"not within {LIMIT_S} s: {json.dumps(status, indent=1)}")


def test_a_pool_from_init_to_down(fogft, home, tmp_path):
    def look() -> dict:
        return read(composition.paths_of("echo"), time.time()).to_json()

    def ready(status: dict) -> dict[int, int]:
        return {r["slot"]: r["generation"] for r in status["replicas"] if r["phase"] == "ready"}

    file = fogft("init", "echo", "--into", str(tmp_path / "echo")).stdout.splitlines()[0]
    said = fogft("up", file)
    assert said.stdout == ""
    assert said.stderr.splitlines()[-1].startswith("done: `echo` answers, with ")
    assert home.stat().st_mode & 0o077 == 0
    status = wait_for(look, lambda s: len(ready(s)) == 2)
    assert status["manager_alive"]
    assert status["services"][0]["ready_replicas"] == 2
    uid = status["uid"]
    assert json.loads(fogft("status", "--json").stdout)["uid"] == uid

    fogft("chaos", "freeze", "1")
    wait_for(look, lambda s: any(r["link"] == "suspect" for r in s["replicas"]))
    fogft("chaos", "thaw", "1")
    fogft("chaos", "kill", "0")
    wait_for(look, lambda s: ready(s).get(0, 0) == 2 and len(ready(s)) == 2)
    fogft("scale", "down", "1")
    wait_for(look, lambda s: len(s["replicas"]) == 1 and s["target"] == 1)

    os.kill(status["manager_pid"], 9)
    again = wait_for(look, lambda s: s["manager_alive"] and s["epoch"] > status["epoch"])
    os.kill(again["manager_pid"], signal.SIGTERM)
    wait_for(look, lambda s: not s["manager_alive"])
    asked = fogft("status", "--refresh")
    assert "no manager is running" in asked.stderr
    assert "1 of 1 ready" in asked.stdout
    assert "the pool had no manager" in fogft("up", file).stderr
    renewed = json.loads(fogft("status", "--refresh", "--json").stdout)
    assert renewed["manager_alive"]
    assert renewed["epoch"] > again["epoch"]

    logs = fogft("logs", "-n", "1000").stdout
    assert {line.split()[0] for line in logs.splitlines()} >= {"manager", "proxy", "0.1", "0.2"}
    assert "replica_ready" in logs
    doctor = json.loads(fogft("doctor", file, "--json").stdout)
    assert not [finding for finding in doctor if finding["verdict"] == "fail"]

    ended = fogft("down").stderr
    assert "ended manager (pid " in ended
    assert "ended client proxy (pid " in ended
    assert ended.splitlines()[-1] == "done: `echo` is shut down; nothing is left"
    assert processes.find(pool_uid=uid) == []
    assert list((home / "pools").iterdir()) == []
    assert fogft("down").stderr == "no pools on this machine\n"


def test_a_manager_run_by_hand_tells_why_it_cannot(fogft, home):
    """`fogft manager` ends as every command does: an error and a hint, no trace."""
    identity = lay_down(home, None).identity
    identity.write_text(identity.read_text().replace('"local"', '"mars"'))
    said = fogft("manager", "planner", status=1).stderr
    assert said.startswith("error: there is no cloud `mars`\n\nhint: there are: `local`, `sky`")
    identity.unlink()
    assert "error: there is no pool `planner`" in fogft("manager", "planner", status=1).stderr
