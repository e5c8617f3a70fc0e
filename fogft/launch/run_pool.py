"""``python -m fogft.launch.run_pool FILE``: the process that a launch file starts for a pool.

Starts the pool, prints a line that the launch file waits for, then shows the replicas' logs. Exits
on a signal, or when launch ends; with `--down` it shuts the pool down first.
"""

import argparse
import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from fogft.child import python, tied
from fogft.errors import FogftError, StateError
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import read_identity
from fogft.process import Wakeup, ending_signals

_LOGS_AGAIN_S = 5
_LOOK_S = 0.1
_PR_SET_PDEATHSIG = 1
READY = "fogft_pool_ready"  # a line on stdout for the launch file


def main(arguments: Sequence[str]) -> int:
    """Run a pool until a signal arrives; return the exit status."""
    parser = argparse.ArgumentParser(prog="fogft.launch.run_pool")
    parser.add_argument("file")
    parser.add_argument("--pool", required=True)
    parser.add_argument("--cloud")
    parser.add_argument("--timeout")
    parser.add_argument("--down", action="store_true")
    asked = parser.parse_args(arguments)
    stop = Wakeup()
    for number in ending_signals():
        signal.signal(number, lambda *_: stop.wake())
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)  # even if it is killed
    status = 0
    try:
        status = _run(asked, stop)
    finally:
        if asked.down and _is_ours(asked):
            ended = _fogft("down", asked.pool, "--yes").wait()
            status = status or ended
    return status


def _is_ours(asked: argparse.Namespace) -> bool:
    """Whether the pool was started from this file. If not, `up` was refused: leave it running."""
    try:
        return read_identity(PoolPaths.of(asked.pool)).file == str(Path(asked.file).resolve())
    except StateError:
        return True  # `down` says what is wrong
    except FogftError:
        return False


def _run(asked: argparse.Namespace, stop: Wakeup) -> int:
    options = ["--yes"]
    if asked.cloud:
        options += ["--cloud", asked.cloud]
    if asked.timeout:
        options += ["--timeout", asked.timeout]
    status = _wait(_fogft("up", asked.file, *options), stop)
    if status != 0:
        return status or 0
    print(READY, flush=True)
    while _is_ours(asked):  # both go on if `logs` is killed
        logs = _fogft("logs", "--follow", "--lines", "0", "--pool", asked.pool)
        if _wait(logs, stop) is None or stop.wait(_LOGS_AGAIN_S):
            break
    return 0


def _fogft(*words: str) -> subprocess.Popen[bytes]:
    """Start a command in its own session, because we forward a terminal's Ctrl-C ourselves."""
    return subprocess.Popen(
        tied(python("-m", "fogft", *words)),
        stdin=subprocess.DEVNULL,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )


def _wait(child: subprocess.Popen[bytes], stop: Wakeup) -> int | None:
    """Return a child's status, or None once this process is to stop, with the child ended."""
    while child.poll() is None:
        if stop.wait(_LOOK_S):
            child.send_signal(signal.SIGINT)
            try:
                child.wait(5)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()
            return None
    return child.returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
