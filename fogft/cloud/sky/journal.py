"""The journal of launches requested from SkyPilot: one small file for each replica.

SkyPilot's own list misses a launch in its first seconds, and forgets why one failed. Losing the
journal loses no machine: names and labels in the cloud say the same. All methods raise `StateError`
if a file cannot be read or written.
"""

import contextlib
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Any

from fogft.cloud.sky.naming import cluster_name, replica_of
from fogft.disk import locked, make_folder, read_as, write_json, write_whole
from fogft.errors import StateError
from fogft.model.names import LINK_PORT
from fogft.model.plain import to_plain
from fogft.model.reason import Reason
from fogft.model.replica import Placement, ReplicaId


class Stage(str, Enum):
    """The stage of a launch. It only ever moves down this list."""

    ASKING = "asking"  # requested from SkyPilot; unknown whether it arrived
    LAUNCHING = "launching"  # SkyPilot accepted it as `request`
    SETTING_UP = "setting up"  # the VM runs; the job does not yet
    RUNNING = "running"  # the job runs
    STANDBY = "standby"  # the VM is stopped
    FAILED = "failed"  # it will never run; `failure` says why
    ENDING = "ending"  # being terminated


_ORDER = list(Stage)
UNDER_WAY = frozenset({Stage.ASKING, Stage.LAUNCHING, Stage.SETTING_UP})
ON_THE_MACHINE = frozenset({Stage.SETTING_UP, Stage.RUNNING, Stage.STANDBY})


@dataclass(frozen=True)
class Entry:
    """One launch, as the journal remembers it."""

    id: ReplicaId
    placement: Placement
    usd_per_hour: float
    spec_hash: str
    launched_at: float  # seconds since the epoch
    stage: Stage = Stage.ASKING
    request: str = ""  # SkyPilot's id of the launch request; empty until it is known
    # SkyPilot's number of the job that runs the server proxy; None until known
    job: int | None = None
    failure: Reason | None = None  # as in `Machine.failure`
    running_at: float = 0.0  # when SkyPilot said that the machine runs
    set_up_at: float = 0.0  # when the job was seen to run
    port: int = LINK_PORT  # the link's; 0 where the replica dials out
    # Types that may have been launched instead of the one ordered, and their USD per hour.
    instead: Mapping[str, float] = field(default_factory=dict)
    # `host:port` on a cloud that maps ports, or of an on-demand machine; empty until known
    endpoint: str = ""
    starts: bool = False  # a standby: ended requests are of earlier launches


class Journal:
    """The entries of all pools of this user."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        make_folder(folder)

    def open(self, entry: Entry, files: Mapping[str, bytes]) -> bool:
        """Write a new entry and its files; False if this id already has one."""
        with locked(self._folder / "journal.lock"):
            if self._path(entry.id).exists():
                return False
            folder = self.files(entry.id)
            make_folder(folder)
            write_json(self._path(entry.id), to_plain(entry))  # first, or its files might stay
            try:
                for name, content in files.items():
                    write_whole(folder / name, content)
            except StateError:
                self._remove(entry.id)
                raise
            return True

    def update(self, id: ReplicaId, **changes: Any) -> Entry | None:
        """Change an entry; None when it was closed meanwhile. A stage never moves back."""
        with locked(self._folder / "journal.lock"):
            entry = self.get(id)
            if entry is None:
                return None
            stage = changes.get("stage", entry.stage)
            if _ORDER.index(stage) < _ORDER.index(entry.stage):
                changes = {k: v for k, v in changes.items() if k not in ("stage", "failure")}
            changed = replace(entry, **changes)
            if changed != entry:
                write_json(self._path(id), to_plain(changed))
            return changed

    def close(self, id: ReplicaId) -> None:
        """Forget a replica that is gone, and remove its files. Idempotent."""
        with locked(self._folder / "journal.lock"):
            self._remove(id)

    def _remove(self, id: ReplicaId) -> None:
        shutil.rmtree(self.files(id), ignore_errors=True)
        for path in (self.provision_log(id), self._path(id)):
            with contextlib.suppress(OSError):
                path.unlink()

    def get(self, id: ReplicaId) -> Entry | None:
        """Return an entry, or None."""
        hint = "remove it: fogft finds its machine by name and labels in the cloud"
        return read_as(Entry, self._path(id), hint)

    def entries(self, pool_uid: str = "") -> list[Entry]:
        """Return the entries of one pool, or of all, sorted by id; a damaged entry is an error."""
        ids = (replica_of(path.stem) for path in self._folder.glob("*.json"))
        wanted = sorted(id for id in ids if id and pool_uid in ("", id.pool_uid))
        return [entry for entry in map(self.get, wanted) if entry is not None]

    def files(self, id: ReplicaId) -> Path:
        """Return the folder with a replica's own files."""
        return self._folder / cluster_name(id)

    def provision_log(self, id: ReplicaId) -> Path:
        """Return where the log of a replica's launch is kept."""
        return self._folder / f"{cluster_name(id)}.log"

    def _path(self, id: ReplicaId) -> Path:
        return self._folder / f"{cluster_name(id)}.json"
