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
import time
from collections.abc import Sequence
from pathlib import Path

from fogft.child import python, tied
from fogft.errors import FogftError, StateError
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import read_identity
from fogft.process import ending_signals

_LOGS_AGAIN_S = 5
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
    ending = ending_signals()
    for number in ending:
        signal.signal(number, signal.default_int_handler)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)  # even if it is killed
    status = 0
    try:
        return _run(asked)
    except KeyboardInterrupt:
        pass
    finally:
        for number in ending:
            signal.signal(number, signal.SIG_IGN)  # launch resends it while `down` runs
        if asked.down and _is_ours(asked):
            status = _fogft("down", asked.pool, "--yes").wait()
    return status


def _is_ours(asked: argparse.Namespace) -> bool:
    """Whether the pool was started from this file. If not, `up` was refused: leave it running."""
    try:
        return read_identity(PoolPaths.of(asked.pool)).file == str(Path(asked.file).resolve())
    except StateError:
        return True  # `down` says what is wrong
    except FogftError:
        return False


def _run(asked: argparse.Namespace) -> int:
    options = ["--yes"]
    if asked.cloud:
        options += ["--cloud", asked.cloud]
    if asked.timeout:
        options += ["--timeout", asked.timeout]
    status = _wait(_fogft("up", asked.file, *options))
    if status != 0:
        return status
    print(READY, flush=True)
    while _is_ours(asked):  # both go on if `logs` is killed
        _wait(_fogft("logs", "--follow", "--lines", "0", "--pool", asked.pool))
        time.sleep(_LOGS_AGAIN_S)
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


def _wait(child: subprocess.Popen[bytes]) -> int:
    try:
        return child.wait()
    except KeyboardInterrupt:
        child.send_signal(signal.SIGINT)
        try:
            child.wait(5)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        raise


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
