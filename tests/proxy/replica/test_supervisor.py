"""The user's command is kept running, and nothing of it survives its supervisor."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from fogft.proxy.replica.supervisor import Supervisor
from tests.fakes.proxy import Clock
from tests.fakes.waiting import wait_for


def alive(pid: int) -> bool:
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
    return stat.rsplit(")", 1)[1].split()[0] != "Z"


@pytest.fixture
def supervise(tmp_path):
    made: list[Supervisor] = []

    def make(command: str, folder: Path = tmp_path, **options) -> Supervisor:
        made.append(Supervisor(command, folder, os.environ, **options))
        return made[-1]

    yield make
    for supervisor in made:
        supervisor.stop(0.1)


def test_the_command_runs_in_its_folder_with_its_environment(supervise, tmp_path, monkeypatch):
    monkeypatch.setenv("FOGFT_TEST", "42")
    supervisor = supervise("pwd > where; echo $FOGFT_TEST > what; exec sleep 60")
    supervisor.poll()
    wait_for(lambda: (tmp_path / "what").exists() and (tmp_path / "what").read_text())
    assert (tmp_path / "where").read_text().strip() == str(tmp_path)
    assert (tmp_path / "what").read_text().strip() == "42"


def test_a_dead_command_is_told_once_and_started_again_after_its_backoff(supervise):
    clock = Clock()
    supervisor = supervise("exit 3", clock=clock)
    supervisor.poll()
    wait_for(lambda: supervisor.poll())
    assert supervisor.last_exit == "exited with status 3"
    assert supervisor.restarts == 1  # at once
    wait_for(lambda: supervisor.poll())
    assert not supervisor.alive
    assert not supervisor.poll()
    assert supervisor.restarts == 1
    clock.now += 0.6
    supervisor.poll()
    assert supervisor.restarts == 2


def test_a_command_that_dies_over_requests_is_started_again_at_once_each_time(supervise):
    """It is not its own fault, and others wait."""
    clock = Clock()
    supervisor = supervise("exit 3", clock=clock)
    supervisor.poll()
    for _ in range(4):
        wait_for(lambda: supervisor.poll(at_work=True))
    assert supervisor.restarts == 4


def test_the_wait_doubles_and_is_bounded(supervise):
    clock = Clock()
    supervisor = supervise("exit 0", clock=clock)
    supervisor.backoff_s = (1.0, 4.0)
    waits = []
    for _ in range(5):
        supervisor.poll()
        wait_for(lambda: supervisor.poll())
        waits.append(max(0.0, supervisor.start_at - clock.now))
        clock.now = supervisor.start_at
    assert waits == [0.0, 1.0, 2.0, 4.0, 4.0]


def test_a_signal_is_named(supervise):
    supervisor = supervise("kill -SEGV $$")
    supervisor.poll()
    wait_for(lambda: supervisor.poll())
    assert supervisor.last_exit == "was killed by SIGSEGV"


def test_stop_ends_what_ignores_signals_and_what_it_started(supervise, tmp_path):
    supervisor = supervise("trap '' INT TERM; sleep 61 & echo $! > child; wait; wait; sleep 62")
    supervisor.poll()
    child_file = tmp_path / "child"
    wait_for(lambda: child_file.exists() and child_file.read_text().strip())
    child = int(child_file.read_text())
    supervisor.stop(0.2)
    wait_for(lambda: not alive(child))
    assert not supervisor.alive


def test_what_a_dead_command_had_started_does_not_run_beside_the_next(supervise, tmp_path):
    supervisor = supervise("sleep 64 & echo $! >> children; exit 3")
    supervisor.poll()
    wait_for(lambda: supervisor.poll())
    first = int((tmp_path / "children").read_text().split()[0])
    wait_for(lambda: not alive(first))


def test_a_command_that_cannot_be_started_is_tried_again(supervise, tmp_path):
    supervisor = supervise("true", tmp_path / "missing")
    assert not supervisor.poll()
    assert "cannot be started" in supervisor.last_exit


def test_the_command_dies_with_a_supervisor_that_is_killed(tmp_path):
    """Whatever ends the server proxy, the user's command does not outlive it."""
    program = (
        "import os, signal, sys, pathlib\n"
        "from fogft.proxy.replica.supervisor import Supervisor\n"
        "s = Supervisor('echo $$; exec sleep 63', pathlib.Path(sys.argv[1]), os.environ)\n"
        "s.poll(); signal.pause()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        assert alive(child)
        parent.send_signal(signal.SIGKILL)
    wait_for(lambda: not alive(child))
