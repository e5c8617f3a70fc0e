"""What a launch file runs for a pool: up, one line, the logs, and down on a signal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fogft.launch.run_pool import READY
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import Identity, write_identity
from tests.fakes.waiting import wait_for

# Stands in for `python -m fogft`: notes its words, and behaves as FAKE_UP says.
FAKE = """
import os, signal, sys, time
with open(os.environ["TRACE"], "a") as trace:
    trace.write(" ".join(sys.argv[1:]) + "\\n")
if sys.argv[1] == "up":
    if os.environ["FAKE_UP"] == "orphaned":  # launch dies meanwhile
        os.kill(int(os.environ["LAUNCH"]), signal.SIGKILL)
    if os.environ["FAKE_UP"] in ("orphaned", "slow"):
        signal.pause()
    sys.exit(0 if os.environ["FAKE_UP"] == "killed later" else int(os.environ["FAKE_UP"]))
if sys.argv[1] == "logs":
    print(f"0.1 a line, pid {os.getpid()}", flush=True)
    signal.pause()
"""


@pytest.fixture
def run_pool(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    package = tmp_path / "site" / "fogft"
    package.mkdir(parents=True)
    root = Path(__file__).parents[2] / "fogft"
    for path in root.iterdir():
        if path.name != "__main__.py":
            (package / path.name).symlink_to(path)
    (package / "__main__.py").write_text(FAKE)
    started: list[subprocess.Popen[str]] = []

    def start(*options: str, up: str = "0", of: str = "f.yaml") -> subprocess.Popen[str]:
        identity = Identity("p", "0123456789abcdef", "local", str(tmp_path / of), 1.0)
        paths = PoolPaths.of("p", tmp_path / "home")
        paths.folder.mkdir(parents=True)
        write_identity(paths, identity)
        environ = {
            **os.environ, "PYTHONPATH": str(tmp_path / "site"), "FAKE_UP": up,
            "TRACE": str(tmp_path / "trace"), "FOGFT_HOME": str(tmp_path / "home"),
        }  # fmt: skip
        words = [sys.executable, "-m", "fogft.launch.run_pool", "f.yaml", "--pool", "p", *options]
        if up in ("orphaned", "killed later"):
            program = "import os, subprocess, sys; os.environ['LAUNCH'] = str(os.getpid());"
            words = [sys.executable, "-c", f"{program} subprocess.call(sys.argv[1:])", *words]
        child = subprocess.Popen(
            words, env=environ, cwd=tmp_path, stdout=subprocess.PIPE, text=True
        )
        started.append(child)
        return child

    yield start
    for child in started:
        child.kill()
        child.wait()


def trace(folder: Path) -> list[str]:
    return (folder / "trace").read_text().splitlines()


def test_up_then_one_line_then_the_logs(run_pool, tmp_path: Path) -> None:
    child = run_pool("--cloud", "local", "--timeout", "9")
    assert child.stdout.readline() == f"{READY}\n"
    assert child.stdout.readline().startswith("0.1 a line")
    child.send_signal(signal.SIGINT)
    assert child.wait(20) == 0
    assert trace(tmp_path) == [
        "up f.yaml --yes --cloud local --timeout 9",
        "logs --follow --lines 0 --pool p",
    ]


def test_the_pool_goes_on_without_its_logs(run_pool, tmp_path: Path) -> None:
    """Who shows them may be killed: that is no reason to end a launch, and the robot's nodes."""
    child = run_pool("--down")
    assert child.stdout.readline() == f"{READY}\n"
    os.kill(int(child.stdout.readline().split()[-1]), signal.SIGKILL)
    assert child.stdout.readline().startswith("0.1 a line"), "they are shown again"
    assert "down p --yes" not in trace(tmp_path)
    child.send_signal(signal.SIGINT)
    assert child.wait(20) == 0
    assert trace(tmp_path)[-1] == "down p --yes"


def test_a_pool_whose_launch_has_died_during_up_ends(run_pool, tmp_path: Path) -> None:
    run_pool("--down", up="orphaned").wait(20)
    wait_for(lambda: trace(tmp_path)[1:] == ["down p --yes"], 20)


def test_a_pool_whose_launch_is_killed_ends_though_no_replica_says_anything(
    run_pool, tmp_path: Path
) -> None:
    child = run_pool("--down", up="killed later")
    wait_for(lambda: (tmp_path / "trace").exists() and len(trace(tmp_path)) == 2, 20)
    child.kill()
    wait_for(lambda: trace(tmp_path)[2:] == ["down p --yes"], 20)


def test_a_pool_that_another_file_has_started_goes_on(run_pool, tmp_path: Path) -> None:
    """Its `up` was refused: this launch file has started nothing."""
    assert run_pool("--down", up="1", of="other.yaml").wait(20) == 1
    assert trace(tmp_path) == ["up f.yaml --yes"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_pool_ends_with_it_when_asked_to(run_pool, tmp_path: Path, number: int) -> None:
    child = run_pool("--down")
    assert child.stdout.readline() == f"{READY}\n"
    child.stdout.readline()
    child.send_signal(number)
    child.send_signal(number)  # launch and the terminal both send one
    assert child.wait(20) == 0
    assert trace(tmp_path)[-1] == "down p --yes"
    assert len(trace(tmp_path)) == 3


def test_a_pool_that_does_not_come_up_is_told_by_the_status(run_pool, tmp_path: Path) -> None:
    child = run_pool("--down", up="3")
    assert child.wait(20) == 3
    assert READY not in child.stdout.read()
    assert trace(tmp_path) == ["up f.yaml --yes", "down p --yes"]


def test_an_interrupt_during_up_still_ends_the_pool(run_pool, tmp_path: Path) -> None:
    child = run_pool("--down", up="slow")
    while not (tmp_path / "trace").exists():
        assert child.poll() is None
    child.send_signal(signal.SIGINT)
    assert child.wait(20) == 0
    assert trace(tmp_path)[-1] == "down p --yes"
