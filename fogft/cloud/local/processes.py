"""Find and kill all processes of a machine or a pool, and tie a machine's processes together.

Their initial environment has ``FOGFT_MACHINE`` and ``FOGFT_POOL_UID``; a process with a clean one
is found as a descendant of a marked process. The guard, the machine's parent, shares its lock, so
the machine counts as alive until all of it is gone. See docs/design/local-cloud.md.
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
    """Return the live processes of a pool or machine (`ReplicaId` text), or all; never this one."""
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
        except OSError:  # it has exited, or is another user's
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
    """Kill a machine's processes except `spare`; return whether there were any.

    All are stopped first: if one is killed while it forks, its child might be untraceable.
    """
    held: set[int] = set()
    while new := set(find(machine=machine)) - set(spare) - held:
        send(new, signal.SIGSTOP)
        held |= new
    end(held)
    return bool(held)


def send(pids: Iterable[int], number: signal.Signals) -> None:
    """Send a signal to processes; ignore those that are gone."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(pid, number)


def alive(pid: int) -> bool:
    """Return whether a process exists and is not a zombie."""
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
    """Fork guard and machine, before any thread starts; return the guard's pid in the machine."""
    # Every orphan below this process stays a descendant.
    _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    guard = os.getpid()
    machine = os.fork()
    if machine == 0:
        _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)  # not inherited
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
