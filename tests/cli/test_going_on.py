"""Commands that go on until they are interrupted, or until nobody reads them any more."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from fogft import disk
from fogft.model.plain import to_plain
from tests.fakes.pools import STATUS, alive, lay_down
from tests.fakes.waiting import wait_for


@contextmanager
def going_on(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run a command in the background; it is over at the end."""
    with subprocess.Popen(
        [sys.executable, "-m", "fogft", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def ignores_hang_up(pid: int) -> bool:
    """Return whether a process ignores SIGHUP."""
    status = Path(f"/proc/{pid}/status").read_text()
    [ignored] = re.findall(r"^SigIgn:\s*(\w+)$", status, re.MULTILINE)
    return bool(int(ignored, 16) & 1 << signal.SIGHUP - 1)


def interrupted(process: subprocess.Popen[str]) -> bool:
    """Interrupt a command; return whether it ended as it should."""
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=100)
    return (stderr, process.returncode) == ("interrupted\n", 130)


def test_logs_are_followed(home):
    paths = lay_down(home)
    paths.manager_log.write_text("one\ntwo\n")
    with going_on("logs", "-f", "-n", "1") as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "manager  two\n"
        with paths.manager_log.open("a") as log:
            log.write("three\n")
        assert process.stdout.readline() == "manager  three\n"
        paths.proxy_log.write_text("a log that was not there before\n")
        assert process.stdout.readline() == "proxy    a log that was not there before\n"
        assert interrupted(process)


def test_a_watched_status_is_said_again_and_again(home):
    paths = lay_down(home)
    with alive(paths), going_on("status", "--watch", "--json") as process:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["target"] == 3
        disk.write_json(paths.status, to_plain(replace(STATUS, target=5)))
        while json.loads(process.stdout.readline())["target"] != 5:
            pass
        assert interrupted(process)


def test_a_watch_ends_with_its_pool(home):
    paths = lay_down(home)
    with going_on("status", "--watch") as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("planner  not answering")
        paths.status.unlink()
        paths.identity.unlink()
        _, stderr = process.communicate(timeout=100)
    assert stderr.startswith("error: there is no pool `planner`")
    assert process.returncode == 1


@pytest.mark.parametrize("hangs_up", [False, True])
def test_a_pool_is_shut_down_though_nobody_reads_it(home, hangs_up):
    """A terminal that is gone must not leave machines without a manager."""
    paths = lay_down(home)
    holds = "import fcntl, signal, sys; f = open(sys.argv[1], 'w'); fcntl.flock(f, 2);"
    holds += "signal.signal(15, lambda *_: (sys.stdin.read(), sys.exit())); print(flush=True);"
    holds += "signal.pause()"
    command = [sys.executable, "-c", holds, str(paths.manager_lock)]
    with subprocess.Popen(command, stdin=-1, stdout=-1) as manager:
        assert manager.stdout is not None
        assert manager.stdin is not None
        assert manager.stdout.readline() == b"\n"  # `down` would end a pool without a manager
        with going_on("down") as process:
            assert process.stderr is not None
            if hangs_up:
                wait_for(lambda: ignores_hang_up(process.pid), 20)
                process.send_signal(signal.SIGHUP)
            process.stderr.close()
            manager.stdin.close()
            assert process.wait(30) == 0
    assert not paths.folder.exists()


def test_a_reader_that_leaves_ends_it_without_a_trace(home):
    """``fogft status --watch | head -1``."""
    lay_down(home)
    with going_on("status", "--watch") as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("planner  not answering")
        process.stdout.close()
        assert process.wait(30) == 141
        assert process.stderr is not None
        assert process.stderr.read() == ""
