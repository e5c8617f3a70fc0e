"""Start child processes: one that cannot outlive this process, or one independent of it."""

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

# Asks the kernel for SIGKILL on the parent's death, then executes the command. A separate program
# because a `preexec_fn` is unsafe in a process with threads. 1 is PR_SET_PDEATHSIG.
_PROGRAM = """
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, int(signal.SIGKILL), 0, 0, 0)
if os.getppid() != int(sys.argv[1]):
    sys.exit("the parent process died before its child started")
os.execvp(sys.argv[2], sys.argv[2:])
"""


def python(*words: str) -> list[str]:
    """Return a command of this Python without the current folder, from 3.11, on its path."""
    checkout = str(Path(__file__).resolve().parents[1])  # may be imported from there
    safe = sys.version_info >= (3, 11) and (
        sys.flags.safe_path or os.path.abspath(sys.path[0]) != checkout
    )
    return [sys.executable, *(["-P"] if safe else []), *words]


def tied(command: Sequence[str]) -> list[str]:
    """Wrap a command to get SIGKILL when the thread that starts it ends: use the main thread."""
    return [sys.executable, "-IS", "-c", _PROGRAM, str(os.getpid()), *command]


def how_it_ended(status: int) -> str:
    """Describe how a process ended, from its return code (negative for a signal)."""
    if status >= 0:
        return f"exited with status {status}"
    try:
        return f"was killed by {signal.Signals(-status).name}"
    except ValueError:  # a real-time signal
        return f"was killed by signal {-status}"


def detached(
    command: Sequence[str],
    log: Path,
    *,
    folder: Path | None = None,
    environ: Mapping[str, str] | None = None,
) -> subprocess.Popen[bytes]:
    """Start a process in its own session and append its output to a log (mode 0600)."""
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
    try:
        return subprocess.Popen(
            list(command),
            cwd=folder,
            env=environ,
            stdin=subprocess.DEVNULL,
            stdout=descriptor,
            stderr=descriptor,
            start_new_session=True,
        )
    finally:
        os.close(descriptor)
