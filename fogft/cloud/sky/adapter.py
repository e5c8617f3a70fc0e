"""Replicas on real clouds: `fogft.cloud.port.Cloud` through SkyPilot. See docs/design/sky.md."""

from __future__ import annotations

import contextlib
import getpass
import hashlib
import importlib.util
import logging
import math
import os
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

from fogft.cloud.port import Audit, Launch
from fogft.cloud.sky import bake, presence, task, wheel
from fogft.cloud.sky.aws import Aws
from fogft.cloud.sky.census import Census
from fogft.cloud.sky.ending import Ending
from fogft.cloud.sky.following import Following
from fogft.cloud.sky.gcp import Gcp
from fogft.cloud.sky.installed import InstalledSky
from fogft.cloud.sky.journal import ON_THE_MACHINE, UNDER_WAY, Entry, Journal, Stage
from fogft.cloud.sky.naming import MAPPING_CLOUDS, OWNER, cluster_name, label_value, replica_of
from fogft.cloud.sky.presence import Presence
from fogft.cloud.sky.prices import Prices, disk_usd_per_hour
from fogft.cloud.sky.provider import NotAllowedError, Provider
from fogft.cloud.sky.sdk import RefusedError
from fogft.cloud.sky.settings import GROUP
from fogft.cloud.sky.task import check, refuse_what_cannot_be_honoured
from fogft.disk import read_bytes, write_whole
from fogft.errors import CloudError, CloudUnreachable, NoCapacity, QuotaExceeded, StateError
from fogft.model.reason import Cause
from fogft.model.replica import Machine, Offer, ReplicaId
from fogft.process import on_thread

log = logging.getLogger(__name__)

SSH_PORT = 22
_LOG_LINES = 1000
MACHINE_ID = Path("/etc/machine-id")
_ENDS_FRESH_S = 60.0


def _each_second(step: Callable[[], bool]) -> None:
    def run() -> None:
        while step():
            time.sleep(1.0)

    on_thread(run)


def make(folder: Path) -> SkyCloud:
    """Return the real clouds of this user. Imports neither SkyPilot nor boto3 until first use."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a container's user often has no name
        user = f"uid{os.getuid()}"
    # Robots made from one image share user and host name; the machine id tells them apart.
    machine = hashlib.sha256(read_bytes(MACHINE_ID) or b"").hexdigest()[:8]
    owner = f"{user}-{socket.gethostname()}"[:50] + f"-{machine}"
    if not folder.exists() and importlib.util.find_spec("sky") is None:
        InstalledSky().load()  # raises: there is no SkyPilot, and no folder of earlier launches
    google = importlib.util.find_spec("google") and importlib.util.find_spec("google.auth")
    providers = [Aws(), Gcp()] if google else [Aws()]
    return SkyCloud(folder, InstalledSky(), providers, owner=owner)


@dataclass
class SkyCloud:
    """Real clouds. Implements all of `fogft.cloud.port`."""

    folder: Path  # of its records, for all pools of this user
    sky: InstalledSky
    providers: Sequence[Provider] = ()  # clouds that can be asked directly
    _: KW_ONLY
    owner: str  # in the labels of our machines
    clock: Callable[[], float] = time.time
    steady: Callable[[], float] = time.monotonic
    submit: Callable[[Callable[[], None]], object] = on_thread
    repeat: Callable[[Callable[[], bool]], object] = _each_second  # until it returns False
    sleep: Callable[[float], object] = time.sleep
    make_wheel: Callable[[Path], Path] = wheel.make
    make_lock: Callable[[Path], wheel.Locks] = wheel.lock
    check_task = staticmethod(check)

    def __post_init__(self) -> None:
        self._providers = by_name = {provider.cloud: provider for provider in self.providers}
        sky, clock, submit = self.sky, self.clock, self.submit
        self.check = sky.check
        self.journal = journal = Journal(self.folder / "launches")
        self._locks = wheel.LockFolder(self.folder / "locks", self.make_lock)
        self._census = Census(by_name, clock, submit)
        self.unverified = self._census.unverified
        self._presence = seen = Presence(sky, journal, self._census, clock, submit)
        # Asks the provider if possible: SkyPilot's own refresh has to queue.
        self.refresh = seen.refresh
        self._ending = Ending(sky, journal, self._census, self.sleep, clock)
        self._following = Following(
            sky, journal, self._ending, clock, self.steady, seen.clusters.forget
        )
        self._prices = Prices(sky, by_name, clock, submit)
        self.left_out = self._prices.left_out
        self._lock = threading.Lock()
        self._followed: set[ReplicaId] = set()
        self._closed = False
        self._ends: tuple[float, float | None] = (-math.inf, None)  # time of the query, answer

    # -- the port -------------------------------------------------------------------------

    def offers(self, resources: Mapping[str, Any]) -> Sequence[Offer]:
        """See `Cloud`. The cheapest machine in each location; `Prices.instead` returns others."""
        refuse_what_cannot_be_honoured({"resources": resources})
        return self._prices.offers(resources)

    def machines(self, pool_uid: str) -> Sequence[Machine]:
        """See `Cloud`. Costs one read of SkyPilot's records; usually no cloud is queried."""
        entries = self.journal.entries(pool_uid)
        machines = self._presence.machines(pool_uid, entries, self._prices.regions)
        for entry in entries:
            if entry.stage in UNDER_WAY:
                self._follow(entry.id)
        return machines

    def launch(self, order: Launch) -> None:
        """See `Cloud`. Returns when SkyPilot has accepted the request, which takes seconds."""
        if order.is_there:  # SkyPilot starts a stopped cluster when told to launch it
            self.journal.close(order.id)
        cloud = order.placement.cloud
        if order.more_ports and cloud in MAPPING_CLOUDS:
            raise CloudError(
                f"`{cloud}` maps ports, so a gateway there cannot be dialled",
                "name another cloud in `fogft.gateway.resources`",
            )
        group = self._firewall(order)
        instead: Sequence[Offer] = ()
        if not order.is_there:
            instead = self._prices.instead(order.placement, order.limit_usd_per_hour)
        packed = self.make_wheel(self.folder / "wheels")
        generation = f"{order.id.pool_uid}-{order.spec_hash}"
        made = task.build(
            order,
            files=self.journal.files(order.id),
            wheel=packed,
            owner=self.owner,
            instead=[offer.placement for offer in instead],
        )
        begun = Entry(
            *(order.id, order.placement, order.usd_per_hour, order.spec_hash, self.clock()),
            port=0 if order.dials_out else order.link_port,
            starts=order.is_there,
            instead={offer.placement.instance: offer.usd_per_hour for offer in instead},
        )
        files = {**order.files, **self._locks.of(generation, packed)}
        if not self.journal.open(begun, files):
            return
        try:
            request = self.sky.launch(made, cluster_name(order.id), group)
        except RefusedError as error:
            self.journal.close(order.id)
            raise _refusal(error, order) from error
        except CloudUnreachable:
            self._follow(order.id)
            raise
        entry = self.journal.update(order.id, stage=Stage.LAUNCHING, request=request)
        if entry is None or entry.stage is Stage.ENDING:  # terminated meanwhile by another process
            self._ending.end(order.id)
            return
        self._follow(order.id)

    def terminate(self, id: ReplicaId) -> None:
        """See `Cloud`. Returns when SkyPilot and, if it can be asked, the provider agree."""
        with contextlib.suppress(StateError):  # a full disk is no reason to keep paying
            self.journal.update(id, stage=Stage.ENDING)
        try:
            self._ending.end(id)
        finally:
            self._presence.clusters.forget()
        self.journal.close(id)
        self._census.forget(id)

    def stop(self, order: Launch) -> None:
        """See `RealCloud`."""
        self.sky.stop(cluster_name(order.id))
        usd_per_hour = disk_usd_per_hour(order.placement, order.task.get("resources") or {})
        self.journal.update(order.id, stage=Stage.STANDBY, usd_per_hour=usd_per_hour)
        self._presence.clusters.forget()

    def log(self, id: ReplicaId) -> str | None:
        """See `Cloud`. Fetches the end of the log from the machine first; takes seconds."""
        entry, name, told = self.journal.get(id), cluster_name(id), ""
        if entry is None or entry.stage in ON_THE_MACHINE:
            told = self.sky.job_log(name, entry.job if entry else None, _LOG_LINES)
        if not told and entry is not None:
            told = self.sky.provision_log(name, _LOG_LINES)
        path = self.journal.provision_log(id)
        if told:
            write_whole(path, told, durable=False)
        return str(path) if path.exists() else None

    # -- beyond the port --------------------------------------------------------------------

    def credentials_end_at(self) -> float | None:
        """See `RealCloud`. The answer is cached for a minute."""
        now = self.clock()
        if not 0 <= now - self._ends[0] < _ENDS_FRESH_S:
            used = [one for one in self.providers if one.cloud in self._prices.regions]
            ends = [provider.credentials_end_at() for provider in used]
            self._ends = now, min((at for at in ends if at is not None), default=None)
        return self._ends[1]

    def hindrances(self, clouds: Sequence[str], until: float | None) -> Sequence[str]:
        """See `RealCloud`. Also stops an idle API server of another SkyPilot version."""
        found = [self.sky.renew_server()]
        for provider in self.providers:
            at = provider.credentials_end_at() if provider.cloud in clouds else None
            if at is not None and (until is None or at < until):
                hours = max(0.0, at - self.clock()) / 3600
                found.append(
                    f"the credentials of `{provider.cloud}` expire in {hours:.1f} h: after that, "
                    "nothing is launched, replaced or ended until they are renewed"
                )
        return [one for one in found if one]

    def lacking(self, resources: Mapping[str, Any]) -> Mapping[str, str]:
        """See `RealCloud`."""
        asked = task.as_launched(resources)
        return self.sky.lacking({key: asked[key] for key in task.FEATURES if key in asked})

    def exposures(
        self, clouds: Sequence[str], *, open_port: int | None, allow_from: Sequence[str] = ()
    ) -> Sequence[str]:
        """See `RealCloud`."""
        files = self.sky.uploaded_credentials(clouds)
        found = [one.warning() for one in self.providers if one.cloud in clouds or not clouds]
        try:
            self._locks.renew(self.make_wheel(self.folder / "wheels"))
        except CloudError as error:
            found.append(
                "the packages that fogft needs are not pinned, and each VM resolves them itself: "
                f"{error.message}"
            )
        if files is None:
            found.append(
                "the remote API server decides which of its credentials every VM gets: set "
                "`remote_identity: NO_UPLOAD` for its clouds there"
            )
        elif files:
            listed = ", ".join(f"`{file}`" for file in files)
            found.append(
                f"SkyPilot copies these files of yours, and its own ssh key, to every VM: {listed}."
                " No setting prevents that: move away what replicas must not have"
            )
        held = GROUP[:1] if allow_from else ()
        world = ", ".join(f"`{one}`" for one in clouds if one not in held)
        if world and (open_port or allow_from):
            port = f"port {open_port} of every VM (mutual TLS) and " if open_port else ""
            limit = "on AWS, `fogft.allow_from` limits who may connect"
            if allow_from:
                limit = "SkyPilot cannot enforce `fogft.allow_from` there"
            found.append(f"on {world}, {port}ssh's port (keys only) are open to the world: {limit}")
        return [one for one in found if one]

    def bake(self, task: Mapping[str, Any], image: str, folder: Path) -> None:
        """See `RealCloud`."""
        packed, lock = self.make_wheel(self.folder / "wheels"), dict[str, bytes]()
        with contextlib.suppress(CloudError):  # then the image resolves packages, as a VM would
            lock |= self._locks.renew(packed)
        bake.write(folder, task, image, packed, lock)

    def audit(self, pool_uid: str = "") -> Audit:
        """See `Auditing`. Without a pool, all of this user's, by the owner label of machines."""
        self._presence.clusters.forget()
        machines: dict[ReplicaId, Machine] = {}
        for uid in {pool_uid} if pool_uid else self._pools():
            entries = self.journal.entries(uid)
            listed = self._presence.machines(uid, entries, self._prices.regions)
            machines |= {machine.id: machine for machine in listed}
        instances, asked = self._census.everywhere(pool_uid)
        for instance in instances:
            if pool_uid or self._mine(instance.labels):
                machines.setdefault(instance.id, presence.of_instance(instance))
        return Audit(tuple(machines[id] for id in sorted(machines)), asked)

    def close(self) -> None:
        """Stop following launches, which continue. Idempotent."""
        self._closed = True

    def _pools(self) -> set[str]:
        """Return the uids of this user's pools, from the journal and SkyPilot's list."""
        uids = {entry.id.pool_uid for entry in self.journal.entries()}
        for cluster in self._presence.clusters.renew():
            id = replica_of(cluster.name)
            if id is not None and self._mine(cluster.labels):
                uids.add(id.pool_uid)
        return uids

    def _mine(self, labels: Mapping[str, str]) -> bool:
        return labels.get(OWNER, label_value(self.owner)) == label_value(self.owner)

    def _firewall(self, order: Launch) -> str:
        """Return the name of the rule that enforces `allow_from`; empty if there is none."""
        place = order.placement
        provider = self._providers.get(place.cloud)
        if provider is None or not order.allow_from:
            return ""
        links = () if order.dials_out else (order.link_port, *order.more_ports)
        try:
            return provider.firewall(place.region, (SSH_PORT, *links), order.allow_from)
        except NotAllowedError as error:
            raise CloudError(
                f"`fogft.allow_from` cannot be enforced in `{place.location}`: {error}",
                "grant the permissions that docs/how-to/clouds.md lists, also to the manager",
            ) from error

    # -- launches under way -------------------------------------------------------------------

    def _follow(self, id: ReplicaId) -> None:
        with self._lock:
            if id in self._followed or self._closed:
                return
            self._followed.add(id)
        try:
            self.repeat(lambda: self._step(id))
        except OSError as error:  # no thread: `machines` tries again
            log.warning("launch_not_followed replica=%s reason=%r", id.short, str(error))
            with self._lock:
                self._followed.discard(id)

    def _step(self, id: ReplicaId) -> bool:
        more = True
        try:
            more = not self._closed and self._following.step(id)
        except CloudError as error:  # no answer, or an unexpected one: time limits end the launch
            log.warning("launch_unknown replica=%s reason=%r", id.short, error.message)
        except StateError:  # the journal cannot be read: `machines` says so to the user
            more = False
        finally:
            if not more:
                self._presence.clusters.forget()
                with self._lock:
                    self._followed.discard(id)
        return more


def _refusal(error: RefusedError, order: Launch) -> CloudError:
    failure = error.reason
    where = f"`{order.placement.location}`"
    if failure.cause is Cause.CAPACITY:
        return NoCapacity(f"no capacity in {where}: {failure.words}")
    if failure.cause is Cause.QUOTA:
        return QuotaExceeded(
            f"the account's quota is used up in {where}: {failure.words}",
            "request a higher quota, or name other regions",
        )
    hint = ""
    if not order.dials_out and error.kind == "NotSupportedError":
        hint = "if a cloud cannot open ports, let replicas dial the robot: `fogft.dial_in`"
    return CloudError(f"SkyPilot refused to launch in {where}: {failure.words}", hint)
