"""Processes of a module that was imported already: a fork costs a tenth of what its imports do.

One process a module, started with the first of them, imports it, opens nothing and forks. It ends
with this one, and so do what it has forked, if they end when their standard input does.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import weakref
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import IO

ROOT = Path(__file__).parents[2]
_NETWORK = "/proc/thread-self/ns/net"
_OURS, _ENVIRON = os.readlink(_NETWORK), dict(os.environ)
_ONE_AT_A_TIME = threading.Lock()


class Forked:
    """A running module's `main`, as `subprocess.Popen` has it where the names are the same.

    Args:
        module: Its `main` reads arguments, and commands on standard input.
        arguments: Those.
        stderr: Where its messages go.

    Attributes:
        pid: Its process id.
        stdin: Its standard input.
        stdout: Its standard output.
        returncode: Its exit status, or negative the signal that ended it, once `poll` or `wait`
            has seen its end.
    """

    def __init__(self, module: str, arguments: Sequence[str], stderr: int) -> None:
        theirs_in, ours_in = os.pipe()
        ours_out, theirs_out = os.pipe()
        self._ended, theirs_ended = os.pipe()
        weakref.finalize(self, os.close, self._ended)
        with _ONE_AT_A_TIME:
            forks = _forks(module)
            order = json.dumps(arguments).encode()
            socket.send_fds(forks, [order], [theirs_in, theirs_out, stderr, theirs_ended])
            self.pid = int(forks.recv(32))
        for number in (theirs_in, theirs_out, theirs_ended):
            os.close(number)
        self.returncode: int | None = None
        self.stdin: IO[str] = open(ours_in, "w")  # noqa: SIM115 - closed by `kill`
        self.stdout: IO[str] = open(ours_out)  # noqa: SIM115

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def poll(self) -> int | None:
        """Return its exit status if it has ended."""
        if self.returncode is None and select.select([self._ended], [], [], 0)[0]:
            self.returncode = int(os.read(self._ended, 32))
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait until it has ended; return its exit status."""
        if self.returncode is None and not select.select([self._ended], [], [], timeout)[0]:
            raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
        self.poll()
        assert self.returncode is not None
        return self.returncode


def start(module: str, *arguments: str, stderr: int = 2) -> Forked | subprocess.Popen[str]:
    """Start a module's `main`; in another network namespace than this process's own, anew."""
    if os.readlink(_NETWORK) == _OURS:
        return Forked(module, arguments, stderr)
    return subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
        cwd=ROOT,
    )


@cache
def _forks(module: str) -> socket.socket:
    """Start the process that forks; return where it takes orders."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    process = subprocess.Popen(
        [sys.executable, "-m", __name__, module, str(theirs.fileno())],
        pass_fds=[theirs.fileno()], cwd=ROOT, env=_ENVIRON, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    theirs.close()

    def end() -> None:
        ours.close()
        process.wait()

    atexit.register(end)
    return ours


class _Children:
    """What was forked: each end is written to whoever ordered it."""

    def __init__(self) -> None:
        self._told: dict[int, int] = {}
        self._codes: dict[int, int] = {}

    def add(self, pid: int, told: int) -> None:
        self._told[pid] = told
        self._tell()

    def reap(self, *_: object) -> None:
        with contextlib.suppress(ChildProcessError):
            while (found := os.waitpid(-1, os.WNOHANG))[0]:
                self._codes[found[0]] = os.waitstatus_to_exitcode(found[1])
        self._tell()

    def kill(self) -> None:
        """End those that still run: whoever ordered them is gone."""
        for pid in self._told:
            os.kill(pid, signal.SIGKILL)

    def _tell(self) -> None:
        for pid in self._told.keys() & self._codes.keys():
            file, code = self._told.pop(pid, -1), self._codes.pop(pid, 0)
            if file >= 0:  # else a signal has come between
                with contextlib.suppress(BrokenPipeError):
                    os.write(file, str(code).encode())
                os.close(file)


def main() -> None:
    """Fork for each order; end when nobody can give any."""
    name, orders = sys.argv[1], socket.socket(fileno=int(sys.argv[2]))
    module = importlib.import_module(name)
    assert len(os.listdir("/proc/self/task")) == 1, "threads do not survive a fork"
    children = _Children()
    signal.signal(signal.SIGCHLD, children.reap)
    while True:
        order, files, _, _ = socket.recv_fds(orders, 1 << 16, 4)
        if not order:
            break
        *files, ended = files
        if not (pid := os.fork()):
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            orders.close()
            os.close(ended)
            for number, file in enumerate(files):
                os.dup2(file, number)
                os.close(file)
            sys.stdin, sys.stdout = open(0, closefd=False), open(1, "w", closefd=False)  # noqa: SIM115
            sys.argv = [name, *json.loads(order)]
            module.main()
            return
        for file in files:
            os.close(file)
        orders.send(str(pid).encode())
        children.add(pid, ended)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    children.kill()
    with contextlib.suppress(ChildProcessError):
        while True:
            os.wait()


if __name__ == "__main__":
    main()
