"""A pool from `init` to `down`: docs/tutorial/first-pool.md as typed, and what comes later."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fogft.cloud.local import processes
from tests.docs.documents import ROOT, console_commands
from tests.e2e.pool import Pool
from tests.e2e.pool import run as command

pytestmark = [pytest.mark.e2e, pytest.mark.ros, pytest.mark.timeout(500)]

Run = Callable[[str], subprocess.CompletedProcess[str]]


def commands_by_hand() -> list[str]:
    page = (ROOT / "docs" / "tutorial" / "first-pool.md").read_text()
    return console_commands(page.partition("\n## Start the pool\n")[2])


@pytest.fixture
def pool(tmp_path: Path, ros_domain: int):
    made = Pool(tmp_path, ros_domain)
    yield made
    made.close()


@pytest.fixture
def run(pool: Pool) -> Run:
    """Return a function that runs a line as a shell does in which fogft is installed."""
    programs = pool.folder / "bin"
    programs.mkdir()
    for name, words in (("fogft", "-m fogft"), ("python", ""), ("python3", "")):
        (programs / name).write_text(f'#!/bin/sh\nexec {sys.executable} {words} "$@"\n')
        (programs / name).chmod(0o755)
    pool.environ |= {
        "PATH": f"{programs}:{os.environ['PATH']}",
        "ROS_LOG_DIR": str(pool.folder / "ros-log"),
    }

    def line(typed: str) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            ["bash", "-c", typed], env={**pool.environ, "PYTHONPATH": str(ROOT)},
            cwd=pool.folder, capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"$ {typed}\n{done.stdout}\n{done.stderr}"
        return done

    return line


def asked(pool: Pool, words: str) -> subprocess.CompletedProcess[str]:
    """Run a command that the page does not have, in a process that need not import it."""
    done = command(words.split(), pool.environ, pool.folder, 120)
    assert done.returncode == 0, f"fogft {words}\n{done.stdout}\n{done.stderr}"
    return done


def ready(status: dict[str, Any]) -> dict[int, int]:
    return {r["slot"]: r["generation"] for r in status["replicas"] if r["phase"] == "ready"}


def test_the_quick_start_works_as_it_is_written(pool: Pool, run: Run):
    """Each command ends well, and the last one leaves no process.

    Before the last, the pool is left without a manager, and is asked about, and gets one again.
    """
    init, up, *commands, down = commands_by_hand()
    assert (init.split()[:2], up.split()[:2]) == (["fogft", "init"], ["fogft", "up"])
    assert down == "fogft down"
    file = run(init).stdout.splitlines()[0]
    assert up.endswith(file)
    said = run(up)
    assert said.stdout == ""
    assert said.stderr.splitlines()[-1].startswith("done: `planner` answers, with ")
    assert Path(pool.environ["FOGFT_HOME"]).stat().st_mode & 0o077 == 0

    def seen(good: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Return the first status that is good."""
        return pool.wait(lambda: (status := pool.status()) and good(status) and status, 200)

    for typed in commands:
        run(typed)
        if typed == "fogft chaos kill 0":
            seen(lambda s: ready(s).get(0, 0) > 1)  # as the page says, soon
    status = seen(
        lambda s: (
            len(s["replicas"]) == len(ready(s)) == 2
            and not any("us-west-2" in one["location"] for one in s["replicas"])
        )  # excluded
    )
    assert status["manager_alive"]
    seen(lambda s: s["services"][0]["ready_replicas"] == 2)
    uid = status["uid"]
    assert json.loads(asked(pool, "status --json").stdout)["uid"] == uid
    slot = min(ready(status))
    asked(pool, f"chaos freeze {slot}")
    seen(lambda s: any(r["link"] == "suspect" for r in s["replicas"]))
    asked(pool, f"chaos thaw {slot}")
    asked(pool, "scale down 1")
    seen(lambda s: len(s["replicas"]) == 1 and s["target"] == 1)

    os.kill(status["manager_pid"], signal.SIGKILL)
    again = seen(lambda s: s["manager_alive"] and s["epoch"] > status["epoch"])
    os.kill(again["manager_pid"], signal.SIGTERM)
    seen(lambda s: not s["manager_alive"])
    orphaned = asked(pool, "status --refresh")
    assert "no manager is running" in orphaned.stderr
    assert "1 of 1 ready" in orphaned.stdout
    assert "the pool had no manager" in run(up).stderr
    renewed = json.loads(asked(pool, "status --refresh --json").stdout)
    assert renewed["manager_alive"]
    assert renewed["epoch"] > again["epoch"]

    logs = asked(pool, "logs -n 1000").stdout
    assert {line.split()[0] for line in logs.splitlines()} >= {"manager", "proxy", "0.1", "0.2"}
    assert "replica_ready" in logs
    doctor = json.loads(asked(pool, f"doctor {file} --json").stdout)
    assert not [finding for finding in doctor if finding["verdict"] == "fail"]

    ended = run(down).stderr
    assert "ended manager (pid " in ended
    assert "ended client proxy (pid " in ended
    assert ended.splitlines()[-1] == "done: `planner` is shut down; nothing is left"
    assert processes.find(pool_uid=uid) == []
    assert pool.left() == {}
    assert list(Path(pool.environ["FOGFT_HOME"], "pools").iterdir()) == []
    assert run(down).stderr == "no pools on this machine\n"
