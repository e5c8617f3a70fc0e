"""Inject faults into the local cloud, through files that machines watch and through signals."""

import contextlib
import signal
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from fogft import disk
from fogft.cloud.local import ending, faults, processes
from fogft.cloud.local.catalogue import CLOUD
from fogft.cloud.local.cloud import LocalCloud
from fogft.cloud.local.faults import CloudFaults, LinkFaults
from fogft.cloud.local.folder import LINK, NOTICE, MachineFolder
from fogft.errors import CloudError
from fogft.model.replica import ReplicaId
from fogft.poolfile.tree import nearest, shown

OUTAGE_KILL_AFTER_S = 1.0


class Chaos:
    """Injects faults into one local cloud and its pools. CloudError: no such machine or location.

    A location is `region` or `region/zone`, with or without `local/` before it.
    """

    def __init__(self, root: Path) -> None:
        self._cloud = LocalCloud(root)

    def preempt(self, id: ReplicaId, notice_s: float | None = None) -> float:
        """Preempt a machine after `notice_s` (None: the zone's); return the seconds left."""
        folder = self._living(id)
        now = time.time()
        if notice_s is None:
            notice_s = folder.record().zone.notice_s
        return max(0.0, folder.ask_end(now + notice_s, NOTICE) - now)

    def kill(self, id: ReplicaId) -> None:
        """End a machine at once, with SIGKILL; return when it is gone."""
        ending.end(self._cloud.root, self._living(id))

    def freeze(self, id: ReplicaId) -> int:
        """Stop all processes of a machine (SIGSTOP); return how many. Its kernel still answers."""
        self._living(id)
        frozen: list[int] = []
        while (pids := processes.find(machine=str(id))) != frozen:  # including new forks
            processes.send(pids, signal.SIGSTOP)
            time.sleep(0.002)
            frozen = pids if all(map(processes.stopped, pids)) else []
        return len(pids)

    def thaw(self, id: ReplicaId) -> int:
        """Resume a frozen machine (SIGCONT); return how many of its processes were frozen."""
        self._living(id)
        frozen = [pid for pid in processes.find(machine=str(id)) if processes.stopped(pid)]
        processes.send(frozen, signal.SIGCONT)
        return len(frozen)

    def slow(
        self,
        id: ReplicaId,
        delay_s: float = 0.0,
        rate_bytes_per_s: float | None = None,
        for_s: float | None = None,
    ) -> None:
        """Delay a machine's traffic, each way, and limit its rate. `for_s` None: until `clear`."""
        if not 0 <= delay_s <= 3600 or not (rate_bytes_per_s is None or rate_bytes_per_s >= 1):
            raise CloudError("the delay is out of range", "give a delay of 0 to 3600 s")
        until = _deadline(for_s)
        self._change_link(id, delay_s=delay_s, rate_bytes_per_s=rate_bytes_per_s, slow_until=until)

    def blackhole(self, id: ReplicaId, for_s: float | None = None) -> None:
        """Drop a machine's traffic; connections stay open. `for_s` None: until `clear`."""
        self._change_link(id, blackhole=True, blackhole_until=_deadline(for_s))

    def outage(self, location: str, for_s: float | None = None) -> list[ReplicaId]:
        """Cut off, then end all machines in a location; refuse launches there during the outage."""
        place = self._location(location)
        until = _deadline(for_s)
        self._change_cloud(lambda old: replace(old, outages={**old.outages, place: until}))
        hit = []
        for folder, placement in self._cloud.living():
            if placement.within(place):
                with contextlib.suppress(CloudError):  # it ends anyway
                    self.blackhole(folder.id)
                folder.ask_end(time.time() + OUTAGE_KILL_AFTER_S)
                hit.append(folder.id)
        return sorted(hit)

    def capacity(self, location: str, machines: int) -> None:
        """Set how many machines a location has room for; running ones stay."""
        place = self._location(location)
        self._change_cloud(lambda old: replace(old, capacity={**old.capacity, place: machines}))

    def clear(self) -> None:
        """Clear all lasting faults: slow and dead links, frozen machines, outages, capacities."""
        with ending.cloud_lock(self._cloud.root):
            faults.write(self._cloud.root / faults.FILE, CloudFaults())
        for folder, _ in self._cloud.living():
            with contextlib.suppress(CloudError):  # it has just ended, or has no relay
                self.thaw(folder.id)
                self._change_link(folder.id, **asdict(LinkFaults()))

    def _living(self, id: ReplicaId) -> MachineFolder:
        folder = MachineFolder.under(self._cloud.machines_folder, id)
        if not folder.exists or not folder.lives(time.time()):
            raise CloudError(
                f"replica `{id.short}` has no machine on the local cloud now",
                "`fogft status` shows which ones run",
            )
        return folder

    def _change_link(self, id: ReplicaId, **changes: Any) -> None:
        folder = self._living(id)
        if not folder.record().zone.relay:
            raise CloudError(
                f"the link to replica `{id.short}` has no relay",
                "remove `relay: false` from `regions.yaml` and replace the machine",
            )
        with disk.locked(folder.path / "link.lock"):
            path = folder.path / LINK
            faults.write(path, replace(faults.read_link(path), **changes))

    def _change_cloud(self, change: Callable[[CloudFaults], CloudFaults]) -> None:
        with ending.cloud_lock(self._cloud.root):
            known = faults.read_cloud(self._cloud.root)
            faults.write(self._cloud.root / faults.FILE, change(known))

    def _location(self, text: str) -> str:
        """Return a location's full name, if it exists."""
        place = text.strip().rstrip("/")
        place = place if place.split("/")[0] == CLOUD else f"{CLOUD}/{place}"
        zones = self._cloud.catalogue().zones
        known = {f"{CLOUD}/{zone.region}" for zone in zones} | {zone.location for zone in zones}
        if place not in known and place != CLOUD:
            what = f"the local cloud has no location {shown(text)}"
            raise CloudError(what, nearest(place, known))
        return place


def _deadline(for_s: float | None) -> float | None:
    return None if for_s is None else time.time() + for_s
