"""Terminate machines: remove processes, folder and shared memory, and keep the log.

A machine is gone when none of its processes is left and its folder has been removed. Its log is
then in ``logs/``, which also marks its id as used. `CloudUnreachable`: it may not be gone.
"""

import contextlib
import logging
import os
import time
from collections.abc import Iterator
from pathlib import Path

from fogft import disk
from fogft.cloud.local import processes
from fogft.cloud.local.folder import END, LOCK, NOTICE, STATE, Life, MachineFolder, remove
from fogft.errors import CloudUnreachable, StateError
from fogft.model.replica import ReplicaId

log = logging.getLogger(__name__)

LOGS_KEPT = 100
_LOCK_LIMIT_S = 5.0
_PATIENCE_S = 1.0
_POLL_S = 0.01


def kept_log(root: Path, id: ReplicaId) -> Path:
    """Return the path of an ended machine's log."""
    return root / "logs" / f"{id}.log"


def end(root: Path, folder: MachineFolder) -> None:
    """Terminate a machine in any state; return when it is gone. Idempotent."""
    if folder.exists:
        with contextlib.suppress(StateError):  # a full disk must not keep it alive
            folder.ask_end(0.0)  # seen by a process that only starts now
    ran = processes.end_machine(str(folder.id))
    with cloud_lock(root):
        ran |= processes.end_machine(str(folder.id))  # a launcher may have spawned one meanwhile
        _remove(root, folder, keep_log=True)
    if ran:
        sweep_shared_memory()


def bury(root: Path, folder: MachineFolder) -> bool:
    """Remove what is left of a dead machine, under the cloud's lock; return whether it is gone."""
    lock = disk.Lock(folder.path / LOCK)
    try:
        if not lock.acquire(wait=False):
            return False  # it is alive, or another process is checking it
    except FileNotFoundError:
        return True
    try:
        processes.end_machine(str(folder.id))
        # If its process never ran, the same id may be launched again.
        ran = folder.log.exists() and folder.log.stat().st_size > 0
        _remove(root, folder, keep_log=ran or (folder.path / STATE).exists())
    except CloudUnreachable as error:
        log.warning("machine_not_gone replica=%s reason=%r", folder.id.short, error.message)
        return False
    finally:
        lock.release()
    return True


def overdue(folder: MachineFolder, now: float) -> bool:
    """Return whether a machine should have ended by itself and has not, so it is frozen."""
    try:
        due = (at for at in map(folder.due, (NOTICE, END)) if at is not None)
        return any(now > at + _PATIENCE_S for at in due) and folder.life(now) is Life.ALIVE
    except StateError:
        return False


@contextlib.contextmanager
def cloud_lock(root: Path, limit_s: float = _LOCK_LIMIT_S) -> Iterator[None]:
    """Hold the cloud's lock: nobody else launches or removes a machine meanwhile."""
    path = root / "cloud.lock"
    lock = disk.Lock(path)
    deadline = time.monotonic() + limit_s
    try:
        disk.make_folder(root)
        while not lock.acquire(wait=False):
            if time.monotonic() > deadline:
                raise CloudUnreachable(
                    f"`{path}` has been held by another process for {limit_s:g} s",
                    "is a fogft process stopped or hanging?",
                )
            time.sleep(_POLL_S)
    except (OSError, StateError) as error:
        raise CloudUnreachable(f"`{path}` cannot be used: {error}") from error
    try:
        yield
    finally:
        lock.release()


def _remove(root: Path, folder: MachineFolder, *, keep_log: bool) -> None:
    if not folder.exists:
        return
    try:
        if keep_log:
            folder.log.touch(mode=0o600)
            disk.make_folder(root / "logs")
            os.replace(folder.log, kept_log(root, folder.id))
            logs = sorted((root / "logs").glob("*.log"), key=lambda path: path.stat().st_mtime)
            for path in logs[:-LOGS_KEPT]:
                path.unlink(missing_ok=True)
        remove(folder.path)
    except (OSError, StateError) as error:
        raise CloudUnreachable(f"`{folder.path}` cannot be removed: {error}") from error


def sweep_shared_memory() -> None:
    """Remove the shared memory that killed ROS processes left behind."""
    from fogft.ros import shared_memory

    with contextlib.suppress(OSError):
        shared_memory.sweep()
