"""A cloud whose machines are files, so that managers can be killed and others take over."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fogft.cloud.port import Audit, Launch
from fogft.errors import CloudUnreachable
from fogft.model.replica import Machine, MachinePhase, Offer, Placement, ReplicaId

ZONES = [Placement("folder", region, "a", "m1") for region in ("one", "two", "three")]


class FolderCloud:
    """Implements `fogft.cloud.port.Cloud`; the file `outage` makes it unreachable."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def offers(self, resources: Mapping[str, Any]) -> Sequence[Offer]:
        return [Offer(zone, 0.1 + index / 1000) for index, zone in enumerate(sorted(ZONES))]

    def machines(self, pool_uid: str) -> Sequence[Machine]:
        self._reach()
        return self._listed(self.folder.glob(f"{pool_uid}-*.json"))

    def launch(self, order: Launch) -> None:
        self._reach()
        with (self.folder / "launched").open("a") as log:
            log.write(f"{order.id.short}\n")
        value = {
            "id": [order.id.pool_uid, order.id.slot, order.id.generation],
            "region": order.placement.region,
            "hash": order.spec_hash,
            "at": time.time(),
            "files": sorted(order.files),
        }
        partial = self.folder / f".{order.id}"
        partial.write_text(json.dumps(value))
        partial.rename(self.folder / f"{order.id}.json")

    def audit(self, pool_uid: str = "") -> Audit:
        """Find also what `forget` has taken out of the list."""
        self._reach()
        paths = [*self.folder.glob(f"{pool_uid}*.json"), *self.folder.glob(f"{pool_uid}*.lost")]
        asked = frozenset() if (self.folder / "mute").exists() else frozenset({"folder"})
        return Audit(tuple(self._listed(paths)), asked)

    def _listed(self, paths: Iterable[Path]) -> list[Machine]:
        found = []
        for path in paths:
            with contextlib.suppress(FileNotFoundError):  # it has just been ended
                found.append(self._read(path))
        return sorted(found, key=lambda m: m.id)

    def forget(self, id: ReplicaId) -> None:
        """Lose a machine that runs on, as SkyPilot does with its database."""
        (self.folder / f"{id}.json").rename(self.folder / f"{id}.lost")

    def terminate(self, id: ReplicaId) -> None:
        self._reach()
        if (self.folder / f"keep-{id.short}").exists():
            raise CloudUnreachable("told to keep it")
        for suffix in ("json", "lost"):
            (self.folder / f"{id}.{suffix}").unlink(missing_ok=True)

    def log(self, id: ReplicaId) -> str | None:
        return None

    def keep(self, short: str) -> Path:
        """Let nobody end a machine until the returned file is removed."""
        path = self.folder / f"keep-{short}"
        path.touch()
        return path

    def launched(self) -> list[str]:
        """Return every launch ever ordered, as ``slot.generation``."""
        log = self.folder / "launched"
        return log.read_text().split() if log.exists() else []

    def _reach(self) -> None:
        if (self.folder / "outage").exists():
            raise CloudUnreachable("told to be")

    def _read(self, path: Path) -> Machine:
        value = json.loads(path.read_text())
        id = ReplicaId(*value["id"])
        return Machine(
            id=id,
            placement=Placement("folder", value["region"], "a", "m1"),
            phase=MachinePhase.RUNNING,
            launched_at=value["at"],
            endpoint=f"127.0.0.1:{1000 + id.slot * 100 + id.generation}",
            usd_per_hour=0.1,
            spec_hash=value["hash"],
        )
