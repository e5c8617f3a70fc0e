"""The local cloud: replicas as folders, locks and processes. See docs/design/local-cloud.md."""

import contextlib
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from fogft.child import detached
from fogft.cloud.local import catalogue, ending, faults, processes
from fogft.cloud.local.catalogue import CLOUD, Catalogue, Zone
from fogft.cloud.local.folder import NOTICE, Life, MachineFolder, Record, State, remove, write_new
from fogft.cloud.local.resources import offers_for
from fogft.cloud.port import Audit, Launch
from fogft.errors import CloudError, CloudUnreachable, NoCapacity, StateError
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Machine, MachinePhase, Offer, Placement, ReplicaId
from fogft.poolfile.tree import nearest

log = logging.getLogger(__name__)

SERVE = (sys.executable, "-m", "fogft", "serve")  # starts a server proxy; without its options
# Variables that tie a process to the unit that started it; they are wrong in a machine.
_NOT_INHERITED = ("NOTIFY_SOCKET", "LISTEN_FDS", "LISTEN_FDNAMES", "LISTEN_PID", "WATCHDOG_USEC")
_UNKNOWN = Placement("local", "unknown", "unknown", "unknown")


class LocalCloud:
    """Replicas as local processes (`fogft.cloud.port.Cloud`). Thread- and process-safe."""

    def __init__(self, root: Path, serve: Sequence[str] = SERVE) -> None:
        self.root = Path(os.path.abspath(root))
        self.machines_folder = self.root / "machines"
        self._serve = tuple(serve)
        self._spawned: list[subprocess.Popen[bytes]] = []
        self._spawned_lock = threading.Lock()
        self._warned: set[str] = set()

    def catalogue(self) -> Catalogue:
        """Return the catalogue: ``regions.yaml``, or the built-in one."""
        return catalogue.read(self.root / catalogue.FILE)

    def offers(self, resources: Mapping[str, Any]) -> Sequence[Offer]:
        """Return an offer for each matching zone, even a full one: only a launch can tell."""
        return offers_for(self.catalogue(), resources)

    def machines(self, pool_uid: str) -> Sequence[Machine]:
        """List the pool's machines, and remove those that died."""
        self._reap()
        now = time.time()
        found = []
        for folder in self.folders():
            if folder.id.pool_uid != pool_uid:
                continue
            if ending.overdue(folder, now):
                ending.end(self.root, folder)
                continue
            machine = self._machine(folder, now)
            if machine is not None:
                found.append(machine)
        return sorted(found, key=lambda machine: machine.id)

    def launch(self, order: Launch) -> None:
        """Write the machine's folder, then start its process; both outlive the caller."""
        zone = self._zone(order)
        self.folders()  # raises if unreadable: this may be a repeated order
        with ending.cloud_lock(self.root):
            folder = MachineFolder.under(self.machines_folder, order.id)
            if not self._is_new(folder):
                return
            if not folder.exists:
                self._check_room(zone, order)
                record = Record(replace(order, files={}), zone, time.time(), self._serve)
                write_new(folder, record, order.files)
            try:
                self._spawn(folder)
            except OSError as error:
                remove(folder.path)
                raise CloudError(
                    f"cannot start machine `{order.id.short}`: {error}",
                    "check free memory and the process limit (`ulimit -u`)",
                ) from error
        log.info("machine_launched replica=%s zone=%s", order.id.short, zone.location)

    def terminate(self, id: ReplicaId) -> None:
        """Kill all of a machine's processes and remove its folder."""
        self.folders()
        ending.end(self.root, MachineFolder.under(self.machines_folder, id))
        self._reap()

    def audit(self, pool_uid: str = "") -> Audit:
        """See `fogft.cloud.port.Auditing`: the machines' folders are the only record."""
        uids = {pool_uid} if pool_uid else {folder.id.pool_uid for folder in self.folders()}
        found = (machine for uid in sorted(uids) for machine in self.machines(uid))
        return Audit(tuple(found), frozenset({CLOUD}))

    def log(self, id: ReplicaId) -> str | None:
        """Return the path of a machine's log, also for a while after the machine has ended."""
        folder = MachineFolder.under(self.machines_folder, id)
        paths = (folder.log, ending.kept_log(self.root, id))
        return next((str(path) for path in paths if path.exists()), None)

    def folders(self) -> list[MachineFolder]:
        """Return the folders of all pools' machines, in any state, unordered."""
        try:
            names = os.listdir(self.machines_folder)
        except FileNotFoundError:
            return []
        except OSError as error:
            what = f"`{self.machines_folder}` cannot be read: {error.strerror}"
            raise CloudUnreachable(what) from error
        found = []
        for name in names:
            folder = MachineFolder.at(self.machines_folder / name)
            if folder is not None:
                found.append(folder)
            elif not name.startswith("."):
                self._warn_once(name, "it is not a machine's folder")
        return found

    def living(self) -> list[tuple[MachineFolder, Placement]]:
        """Return the machines of all pools that count against capacity."""
        now = time.time()
        found = []
        for folder in self.folders():
            with contextlib.suppress(StateError):
                if folder.lives(now):
                    found.append((folder, folder.record().order.placement))
        return found

    # -- one machine ------------------------------------------------------------------------

    def _machine(self, folder: MachineFolder, now: float) -> Machine | None:
        """Return a machine as listed; None if it is gone."""
        try:
            if folder.life(now) is not Life.DEAD:
                return _listed(folder, folder.record(), folder.state())
        except StateError as error:
            if not folder.exists:  # it was ended while we looked
                return None
            self._warn_once(folder.path.name, error.message)
            if folder.locked:
                # Unreadable but alive: list it, so that it can be terminated.
                failure = Reason(Cause.ERROR, words=error.message)
                return Machine(folder.id, _UNKNOWN, MachinePhase.FAILED, now, failure=failure)
        # If the lock is taken, a later call does this: listing never waits.
        with contextlib.suppress(CloudUnreachable), ending.cloud_lock(self.root, 0.0):
            ending.bury(self.root, folder)
        return None

    def _is_new(self, folder: MachineFolder) -> bool:
        """Whether a machine has yet to be started. The caller holds the cloud's lock."""
        if folder.exists:
            try:
                life = folder.life(time.time())
            except StateError:
                life = Life.ALIVE if folder.locked else Life.DEAD
            if life is Life.ORDERED:
                return True  # its launcher may have been killed: a second process does no harm
            if life is not Life.DEAD or not ending.bury(self.root, folder):
                return False
        return not ending.kept_log(self.root, folder.id).exists()

    def _spawn(self, folder: MachineFolder) -> None:
        environ = {k: v for k, v in os.environ.items() if k not in _NOT_INHERITED}
        environ[processes.MACHINE] = str(folder.id)
        environ[processes.POOL] = folder.id.pool_uid
        environ.setdefault("PYTHONUNBUFFERED", "1")  # so that logs appear at once
        package = Path(__file__).resolve().parents[3]
        if package.name not in ("site-packages", "dist-packages"):  # a checkout
            paths = (str(package), environ.get("PYTHONPATH", ""))
            environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
        command = [sys.executable, "-m", "fogft.cloud.local.machine", str(folder.path)]
        process = detached(command, folder.log, folder=folder.path, environ=environ)
        with self._spawned_lock:
            self._spawned.append(process)

    def _reap(self) -> None:
        """Reap the processes of machines that we started and that have ended."""
        with self._spawned_lock:
            self._spawned = [process for process in self._spawned if process.poll() is None]

    # -- room -------------------------------------------------------------------------------

    def _zone(self, order: Launch) -> Zone:
        location = order.placement.location
        zones = {zone.location: zone for zone in self.catalogue().zones}
        if location not in zones:
            raise CloudError(f"there is no zone `{location}`", nearest(location, zones))
        return zones[location]

    def _check_room(self, zone: Zone, order: Launch) -> None:
        """Raise `NoCapacity` unless one more machine fits. The caller holds the cloud's lock."""
        wrong = faults.read_cloud(self.root)
        for location in wrong.out(time.time()):
            if order.placement.within(location):
                raise NoCapacity(f"no capacity in `{zone.location}`: outage in `{location}`")
        limits = {zone.location: zone.capacity}
        limits |= {where: n for where, n in wrong.capacity.items() if order.placement.within(where)}
        taken = [placement for folder, placement in self.living() if folder.id != order.id]
        for location, limit in limits.items():
            here = sum(placement.within(location) for placement in taken)
            if here >= limit:
                raise NoCapacity(
                    f"no capacity in `{zone.location}`: {here} of {limit} machines "
                    f"in `{location}` are taken"
                )

    def _warn_once(self, name: str, reason: str) -> None:
        if name not in self._warned:
            self._warned.add(name)
            log.warning("machine_ignored folder=%s reason=%r", name, reason)


def _listed(folder: MachineFolder, record: Record, state: State | None) -> Machine:
    state = state or State(MachinePhase.PROVISIONING, progress="ordered")
    order = record.order
    return Machine(
        id=folder.id,
        placement=order.placement,
        phase=state.phase,
        launched_at=record.launched_at,
        endpoint=state.endpoint,
        notice=(folder.path / NOTICE).exists(),
        usd_per_hour=order.usd_per_hour,
        spec_hash=order.spec_hash,
        failure=state.failure,
        progress=state.progress,
        setting_up=state.setting_up,
        set_up_at=state.set_up_at,
        pool=order.pool,
    )
