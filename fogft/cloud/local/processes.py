"""Find and end all processes of a machine or a pool, and tie a machine's together.

All carry ``FOGFT_MACHINE`` and ``FOGFT_POOL_UID`` in the environment that they began with; one that
began with a clean one is found as a descendant of one that did not. The machine's guard, its
parent, shares its lock: it counts as alive until all of it is gone. See docs/design/local-cloud.md.
"""

import contextlib
import ctypes
import logging
import os
import signal
import time
from collections.abc import Callable, Collection, Iterable
from pathlib import Path

from fogft.errors import CloudUnreachable, FogftError

MACHINE = "FOGFT_MACHINE"
POOL = "FOGFT_POOL_UID"

log = logging.getLogger(__name__)

_PROC = Path("/proc")
_LIMIT_S = 10.0
_POLL_S = 0.005
_PR_SET_CHILD_SUBREAPER = 36
_libc = ctypes.CDLL(None, use_errno=True)


def find(pool_uid: str | None = None, machine: str | None = None) -> list[int]:
    """Return the living processes of a pool, a machine (`ReplicaId` text) or any, but this one."""
    marks = [f"{MACHINE}={machine}".encode()] if machine else []
    marks += [f"{POOL}={pool_uid}".encode()] if pool_uid else []
    parents: dict[int, int] = {}
    marked: set[int] = set()
    for entry in os.listdir(_PROC):
        if not entry.isdigit():
            continue
        try:
            parent = _parent(entry)
            environ = (_PROC / entry / "environ").read_bytes().split(b"\0")
        except OSError:  # it has ended, or is another user's
            continue
        if parent is None:
            continue
        parents[int(entry)] = parent
        ours = any(item.startswith(f"{MACHINE}=".encode()) for item in environ)
        if ours and all(mark in environ for mark in marks):
            marked.add(int(entry))
    while below := {pid for pid, parent in parents.items() if parent in marked} - marked:
        marked |= below
    return sorted(marked - {os.getpid()})


def end(pids: Iterable[int], limit_s: float = _LIMIT_S) -> None:
    """Kill processes (SIGKILL) and return when they are gone."""
    left = set(pids)
    send(left, signal.SIGKILL)
    deadline = time.monotonic() + limit_s
    while left := {pid for pid in left if alive(pid)}:
        if time.monotonic() > deadline:
            raise CloudUnreachable(
                f"these processes do not exit: {', '.join(map(str, sorted(left)))}",
                "they belong to another user, or hang in the kernel",
            )
        time.sleep(_POLL_S)


def end_machine(machine: str, *, spare: Collection[int] = ()) -> bool:
    """End a machine's processes but some; return if there were any.

    All are stopped first: of one that dies as it forks, the child might be nobody's descendant.
    """
    held: set[int] = set()
    while new := set(find(machine=machine)) - set(spare) - held:
        send(new, signal.SIGSTOP)
        held |= new
    end(held)
    return bool(held)


def send(pids: Iterable[int], number: signal.Signals) -> None:
    """Send a signal to processes; those that are gone meanwhile are fine."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(pid, number)


def alive(pid: int) -> bool:
    """Return whether a process runs: it exists and is no zombie."""
    try:
        return _parent(str(pid)) is not None
    except OSError:
        return False


def stopped(pid: int) -> bool:
    """Return whether a process is stopped by SIGSTOP, or gone."""
    try:
        return _stat(str(pid))[0] in "TtZX"
    except OSError:
        return True


def _parent(pid: str) -> int | None:
    """Return a process's parent; None for a zombie."""
    fields = _stat(pid)
    return None if fields[0] in "ZX" else int(fields[1])


def _stat(pid: str) -> list[str]:
    # The second field, the program's name in parentheses, may hold anything.
    return (_PROC / pid / "stat").read_text(errors="replace").rpartition(")")[2].split()


def start(end_the_rest: Callable[[], None]) -> int:
    """Become the machine, before there are threads; return the process id of the guard above it."""
    # Every orphan below this process stays a descendant.
    _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    guard = os.getpid()
    machine = os.fork()
    if machine == 0:
        _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)  # it is not inherited
        return guard
    try:
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        while os.waitpid(-1, 0)[0] != machine:
            pass
        end_the_rest()
    except FogftError as error:
        log.error("guard_failed reason=%r", error.message)
    finally:
        os._exit(0)
