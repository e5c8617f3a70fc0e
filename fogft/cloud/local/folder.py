"""The folder of one machine: what was ordered, what became of it, and whether it lives.

===============  ==========================================================  ==============
``machine.json``  the order, written once before the process exists          the launcher
``state.json``    how far it has come                                        the machine
``lock``          held (flock) while the machine, or its guard, lives        the machine
``notice.json``   a preemption notice: ``{"action": "terminate", "at": ..}``  `chaos`
``end.json``      it shall end, at once or at a time: ``{"at": ..}``         the cloud, `chaos`
``link.json``     faults of the path to it (`faults.LinkFaults`)             `chaos`
``machine.log``   all output of it and what it runs                          all below it
===============  ==========================================================  ==============

The order's own files (certificates, ``replica.yaml``) lie beside them. Times are seconds
since the epoch.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import TypeVar

from fogft import disk
from fogft.cloud.local import processes
from fogft.cloud.local.catalogue import Zone
from fogft.cloud.port import Launch
from fogft.errors import CloudError, StateError
from fogft.model.plain import stored, to_plain
from fogft.model.reason import Reason
from fogft.model.replica import MachinePhase, ReplicaId

RECORD = "machine.json"
STATE = "state.json"
LOCK = "lock"
NOTICE = "notice.json"
END = "end.json"
LINK = "link.json"
LOG = "machine.log"
OWN_FILES = frozenset({RECORD, STATE, LOCK, NOTICE, END, LINK, "link.lock", LOG})

# From the launcher's rename to the machine's first sign of life, without and with a process
# there: on an overloaded computer it takes its time to start. Longer: it never was.
START_LIMIT_S = 10.0
SLOW_START_LIMIT_S = 60.0

_NAME = re.compile(r"(?P<uid>[0-9a-f]{16})-(?P<slot>\d{1,6})\.(?P<generation>\d{1,9})")


T = TypeVar("T")


class Life(Enum):
    """Whether a machine lives, by its files and its lock."""

    ORDERED = "ordered"  # its process has shown no sign of life yet
    ALIVE = "alive"
    FAILED = "failed"  # it will never run, and says why
    DEAD = "dead"


@dataclass(frozen=True)
class Record:
    """What was ordered, and how its zone was then: ``machine.json``."""

    order: Launch  # without its files
    zone: Zone
    launched_at: float
    serve: tuple[str, ...]  # the command that starts a server proxy, without its options


@dataclass(frozen=True)
class State:
    """What became of it: ``state.json``, which is there once the machine's process ran."""

    phase: MachinePhase
    endpoint: str | None = None
    failure: Reason | None = None
    progress: str = ""
    setting_up: bool = False
    set_up_at: float = 0.0
    pids: Mapping[str, int] = field(default_factory=dict)
    domain_id: int | None = None


@dataclass(frozen=True)
class MachineFolder:
    """The folder of one machine. Reading raises `StateError` where a file is damaged."""

    path: Path
    id: ReplicaId

    @classmethod
    def under(cls, machines: Path, id: ReplicaId) -> MachineFolder:
        """Return the folder that a machine has, or would have."""
        return cls(machines / str(id), id)

    @classmethod
    def at(cls, path: Path) -> MachineFolder | None:
        """Return the machine whose folder this is by its name; None if it is none's."""
        match = _NAME.fullmatch(path.name)
        if match is None:
            return None
        id = ReplicaId(match["uid"], int(match["slot"]), int(match["generation"]))
        return cls(path, id) if str(id) == path.name else None

    @property
    def log(self) -> Path:
        """All output of the machine and of what runs on it."""
        return self.path / LOG

    @property
    def exists(self) -> bool:
        """Whether the folder is there."""
        return self.path.is_dir()

    @property
    def locked(self) -> bool:
        """Whether the machine's process, or its guard, lives."""
        try:
            return disk.is_locked(self.path / LOCK)
        except FileNotFoundError:  # the folder has just gone
            return False

    def life(self, now: float) -> Life:
        """Judge whether the machine lives. Looks twice: it may start or end meanwhile."""
        if self.locked:
            return Life.ALIVE
        state = self.state()
        if self.locked:
            return Life.ALIVE
        if state is None:
            return Life.ORDERED if self._may_start(now) else Life.DEAD
        return Life.FAILED if state.phase is MachinePhase.FAILED else Life.DEAD

    def _may_start(self, now: float) -> bool:
        """Whether a process that has shown no sign of life may still show one."""
        age_s = abs(now - self.record().launched_at)
        if age_s < START_LIMIT_S:
            return True
        return age_s < SLOW_START_LIMIT_S and bool(processes.find(machine=str(self.id)))

    def lives(self, now: float) -> bool:
        """Whether the machine takes up room: it is ordered or alive."""
        return self.life(now) in (Life.ORDERED, Life.ALIVE)

    def record(self) -> Record:
        """Return the order."""
        return self._stored(Record, RECORD, disk.read_json(self.path / RECORD))

    def state(self) -> State | None:
        """Return how far the machine has come; None if its process never ran."""
        raw = disk.read_json(self.path / STATE)
        return None if raw is None else self._stored(State, STATE, raw)

    def write_state(self, state: State) -> None:
        """Say how far the machine has come. Raises `StateError` on a full disk."""
        disk.write_json(self.path / STATE, to_plain(state), durable=False)

    def notice_at(self) -> float | None:
        """Return when a preempted machine ends; None without a notice."""
        return self._at(NOTICE)

    def end_at(self) -> float | None:
        """Return when the machine shall end; None if nobody said so."""
        return self._at(END)

    def ask_end(self, at: float, *, notice: bool = False) -> float:
        """Have the machine end at a time, or earlier if that was asked before. Returns when."""
        known = self._at(NOTICE if notice else END)
        if known is not None and known <= at:
            return known
        value = {"action": "terminate", "at": at}
        disk.write_json(self.path / (NOTICE if notice else END), value, durable=False)
        return at

    def _at(self, name: str) -> float | None:
        raw = disk.read_json(self.path / name)
        return None if raw is None else self._stored(_Moment, name, raw).at

    def _stored(self, kind: type[T], name: str, raw: object) -> T:
        return stored(kind, raw, f"`{self.path / name}` is damaged")


@dataclass(frozen=True)
class _Moment:
    at: float


def write_new(folder: MachineFolder, record: Record, files: Mapping[str, bytes]) -> None:
    """Make a machine's folder, whole or not at all. It must not exist."""
    wrong = [n for n in files if n in OWN_FILES or n != os.path.basename(n) or n.startswith(".")]
    if wrong:
        raise CloudError(f"a machine cannot be given a file of the name `{wrong[0]}`")
    beside = folder.path.with_name(f".new-{folder.path.name}")
    try:
        disk.make_folder(beside.parent)
        remove(beside)  # of a launcher that was killed; we hold the cloud's lock
        beside.mkdir(mode=0o700)
        for name, content in files.items():
            disk.write_whole(beside / name, content, durable=False)
        disk.write_json(beside / RECORD, to_plain(record), durable=False)
        beside.rename(folder.path)
    except (OSError, StateError, TypeError, ValueError) as error:
        with contextlib.suppress(OSError):
            remove(beside)
        reason = error.message if isinstance(error, StateError) else str(error)
        raise CloudError(
            f"machine `{folder.id.short}` cannot be made: {reason}",
            "check the disk's free space and the folder's owner",
        ) from error


def remove(path: Path) -> None:
    """Remove a folder with all that is in it; fine if there is none."""
    with contextlib.suppress(FileNotFoundError):
        shutil.rmtree(path)
