"""The folder of one machine: its order, its state, and whether it is alive.

===============  ==========================================================  ==============
``machine.json``  the order, written once before the process exists          the launcher
``state.json``    its phase and progress                                     the machine
``lock``          held (flock) while the machine or its guard is alive       the machine
``notice.json``   a preemption notice: ``{"action": "terminate", "at": ..}``  `chaos`
``end.json``      a request to end at a time: ``{"at": ..}``                 the cloud, `chaos`
``link.json``     faults of its network path (`faults.LinkFaults`)           `chaos`
``machine.log``   all output of the machine and of what it runs              all its processes
===============  ==========================================================  ==============

The last column names the writer. The launch's own files (certificates, ``replica.yaml``) are in
the same folder. Times are seconds since the epoch.
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

from fogft import disk
from fogft.cloud.local import processes
from fogft.cloud.local.catalogue import Zone
from fogft.cloud.port import Launch
from fogft.errors import CloudError, StateError
from fogft.model.plain import to_plain
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

# From the launcher's rename to the machine's first sign of life, without and with a process, which
# starts slowly on an overloaded computer. After that, the machine is considered never started.
START_LIMIT_S = 10.0
SLOW_START_LIMIT_S = 60.0

_NAME = re.compile(r"(?P<uid>[0-9a-f]{16})-(?P<slot>\d{1,6})\.(?P<generation>\d{1,9})")


class Life(Enum):
    """Whether a machine is alive, judged by its files and its lock."""

    ORDERED = "ordered"  # its process has shown no sign of life yet
    ALIVE = "alive"
    FAILED = "failed"  # it will never run, and says why
    DEAD = "dead"


@dataclass(frozen=True)
class Record:
    """A machine's launch order, and its zone at that time: ``machine.json``."""

    order: Launch  # without `files`
    zone: Zone
    launched_at: float
    serve: tuple[str, ...]  # the command that starts a server proxy, without its options


@dataclass(frozen=True)
class State:
    """A machine's state: ``state.json``, which exists once its process has run."""

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
        """Return the folder of a machine, which need not exist."""
        return cls(machines / str(id), id)

    @classmethod
    def at(cls, path: Path) -> MachineFolder | None:
        """Return the machine folder at a path; None if its name is not that of a machine."""
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
        """Whether the machine's process or its guard is alive."""
        return disk.is_locked(self.path / LOCK)

    def life(self, now: float) -> Life:
        """Return the machine's life. Checks the lock twice, as it may start or end meanwhile."""
        if self.locked:
            return Life.ALIVE
        state = self.state()
        if self.locked:
            return Life.ALIVE
        if state is not None:
            return Life.FAILED if state.phase is MachinePhase.FAILED else Life.DEAD
        age_s = abs(now - self.record().launched_at)
        may_start = age_s < START_LIMIT_S
        if not may_start and age_s < SLOW_START_LIMIT_S:
            may_start = bool(processes.find(machine=str(self.id)))
        return Life.ORDERED if may_start else Life.DEAD

    def lives(self, now: float) -> bool:
        """Whether the machine counts against capacity: it is ordered or alive."""
        return self.life(now) in (Life.ORDERED, Life.ALIVE)

    def record(self) -> Record:
        """Return the launch record."""
        found = disk.read_as(Record, self.path / RECORD)
        if found is None:
            raise StateError(f"`{self.path / RECORD}` is missing")
        return found

    def state(self) -> State | None:
        """Return the machine's state; None if its process never ran."""
        return disk.read_as(State, self.path / STATE)

    def due(self, name: str) -> float | None:
        """Return when a `NOTICE` or `END` file tells the machine to end; None without a file."""
        found = disk.read_as(_Moment, self.path / name)
        return None if found is None else found.at

    def ask_end(self, at: float, name: str = END) -> float:
        """Request the machine's end at a time; an earlier request wins. Returns the time."""
        known = self.due(name)
        if known is not None and known <= at:
            return known
        disk.write_json(self.path / name, {"action": "terminate", "at": at}, durable=False)
        return at


@dataclass(frozen=True)
class _Moment:
    at: float


def write_new(folder: MachineFolder, record: Record, files: Mapping[str, bytes]) -> None:
    """Create a machine's folder atomically. It must not exist."""
    wrong = [n for n in files if n in OWN_FILES or n != os.path.basename(n) or n.startswith(".")]
    if wrong:
        raise CloudError(f"a machine cannot be given a file named `{wrong[0]}`")
    beside = folder.path.with_name(f".new-{folder.path.name}")
    try:
        disk.make_folder(beside.parent)
        remove(beside)  # left by a killed launcher; we hold the cloud's lock
        beside.mkdir(mode=0o700)
        for name, content in files.items():
            disk.write_whole(beside / name, content, durable=False)
        disk.write_json(beside / RECORD, to_plain(record), durable=False)
        beside.rename(folder.path)
    except (OSError, StateError, TypeError, ValueError) as error:
        with contextlib.suppress(OSError):
            remove(beside)
        raise CloudError(
            f"machine `{folder.id.short}` cannot be created: {error}",
            "check the disk's free space and the folder's owner",
        ) from error


def remove(path: Path) -> None:
    """Remove a folder and its contents, if it exists."""
    with contextlib.suppress(FileNotFoundError):
        shutil.rmtree(path)
