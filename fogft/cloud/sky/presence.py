"""A pool's machines, from the journal, SkyPilot's list and the providers' lists.

SkyPilot's list decides what exists; the journal says what a launch is waiting for and why it
failed; the provider is asked about machines that SkyPilot does not list.
"""

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial

from fogft.cloud.sky import naming
from fogft.cloud.sky.census import Census
from fogft.cloud.sky.installed import InstalledSky
from fogft.cloud.sky.journal import ON_THE_MACHINE, Entry, Journal, Stage
from fogft.cloud.sky.kept import Kept
from fogft.cloud.sky.naming import cluster_name, replica_of
from fogft.cloud.sky.provider import Instance
from fogft.cloud.sky.sdk import Cluster, ClusterState
from fogft.errors import CloudError
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Machine, MachinePhase, Placement, ReplicaId

log = logging.getLogger(__name__)

CLUSTERS_FRESH_S = 5.0
CLUSTERS_USABLE_S = 15.0  # until then callers get the old list while a newer one is fetched
PROVIDER_SURE_AFTER_S = 60.0  # a provider's list may miss a machine in its first seconds


def of_entry(entry: Entry, cluster: Cluster | None, instance: Instance | None) -> Machine:
    """Return a machine that has a journal entry; `cluster` and `instance`: None if not found."""
    stage, failure, progress = entry.stage, entry.failure, ""
    if stage is Stage.ENDING:
        # Listed until it is certainly gone, so that a crash in between is repaired.
        failure = failure or _error("its end was not confirmed")
    is_stopped = cluster is not None and cluster.state is ClusterState.STOPPED
    if is_stopped and stage in (Stage.SETTING_UP, Stage.RUNNING):
        failure = _error("the machine was stopped")
    if failure is not None:
        phase = MachinePhase.FAILED
    elif stage is Stage.STANDBY and (cluster is None or is_stopped):
        phase = MachinePhase.STOPPED  # unless somebody else has started it
    elif stage in ON_THE_MACHINE:
        phase = MachinePhase.RUNNING
        progress = stage.value if stage is Stage.SETTING_UP else ""
    else:
        phase = MachinePhase.PROVISIONING
        progress = (cluster.progress if cluster else "") or stage.value
    placement = entry.placement
    if cluster is not None and cluster.placement is not None:
        placement = _as_found(entry, cluster.placement)
    usd_per_hour = entry.instead.get(placement.instance, entry.usd_per_hour)
    if phase is MachinePhase.STOPPED:
        usd_per_hour = entry.usd_per_hour
    ip = (cluster.head_ip if cluster else "") or (instance.public_ip if instance else "")
    return Machine(
        id=entry.id,
        placement=placement,
        phase=phase,
        launched_at=entry.launched_at,
        endpoint=_endpoint(entry, ip) if phase is not MachinePhase.FAILED else None,
        usd_per_hour=usd_per_hour,
        spec_hash=entry.spec_hash,
        failure=failure,
        progress=progress,
        setting_up=phase is MachinePhase.RUNNING and entry.stage is Stage.SETTING_UP,
        running_at=entry.running_at,
        set_up_at=entry.set_up_at,
        pool=cluster.labels.get(naming.NAME, "") if cluster else "",
    )


def of_cluster(id: ReplicaId, cluster: Cluster, *, launching: bool) -> Machine:
    """Return a machine that SkyPilot lists but that has no journal entry."""
    phase, failure, endpoint = MachinePhase.PROVISIONING, None, None
    if cluster.state is ClusterState.UP:
        phase = MachinePhase.RUNNING
        cloud = cluster.placement.cloud if cluster.placement else ""
        if cluster.head_ip and cloud not in naming.MAPPING_CLOUDS:
            endpoint = f"{cluster.head_ip}:{naming.link_port(cluster.labels)}"
    elif not launching:
        phase = MachinePhase.FAILED
        failure = _error(f"SkyPilot says {cluster.state.value}: {cluster.progress or 'no reason'}")
    return Machine(
        id=id,
        placement=cluster.placement or Placement("", "", "", ""),
        phase=phase,
        launched_at=cluster.launched_at,
        endpoint=endpoint,
        usd_per_hour=naming.usd_per_hour(cluster.labels),
        spec_hash=cluster.labels.get(naming.SPEC, ""),
        failure=failure,
        progress=cluster.progress if phase is MachinePhase.PROVISIONING else "",
        pool=cluster.labels.get(naming.NAME, ""),
    )


def of_instance(instance: Instance) -> Machine:
    """Return a machine that only the provider lists: it is unusable and must be terminated."""
    return Machine(
        id=instance.id,
        placement=instance.placement,
        phase=MachinePhase.FAILED,
        launched_at=instance.launched_at,
        usd_per_hour=naming.usd_per_hour(instance.labels),
        spec_hash=instance.labels.get(naming.SPEC, ""),
        failure=_error(f"SkyPilot does not know {instance.placement.cloud} `{instance.key}`"),
        pool=instance.labels.get(naming.NAME, ""),
    )


def _endpoint(entry: Entry, ip: str) -> str | None:
    mapped = entry.placement.cloud in naming.MAPPING_CLOUDS and entry.port
    return f"{ip}:{entry.port}" if ip and not mapped else entry.endpoint or None


def _error(words: str) -> Reason:
    return Reason(Cause.ERROR, words=words)


def _as_found(entry: Entry, found: Placement) -> Placement:
    """Return the ordered placement, with the zone and the substitute type that the cloud chose."""
    asked = entry.placement
    if (asked.cloud, asked.region) != (found.cloud, found.region):
        return asked
    instance = found.instance if found.instance in entry.instead else asked.instance
    return replace(asked, zone=asked.zone or found.zone, instance=instance)


@dataclass
class Presence:
    """Lists the machines of a pool; `submit` runs a function in the background."""

    sky: InstalledSky
    journal: Journal
    census: Census
    clock: Callable[[], float]
    submit: Callable[[Callable[[], None]], object]

    def __post_init__(self) -> None:
        self.clusters = Kept(  # SkyPilot's list of all clusters, of any pool and user
            partial(self.sky.clusters, None, refresh=False),
            *(CLUSTERS_FRESH_S, CLUSTERS_USABLE_S, self.clock, self.submit),
            failed=lambda error: log.info("list_not_renewed reason=%r", error.message),
        )
        self._gone: set[ReplicaId] = set()

    def machines(
        self, pool_uid: str, entries: Iterable[Entry], regions: Mapping[str, Iterable[str]]
    ) -> list[Machine]:
        """Return a pool's machines, sorted by id; `regions`: cloud -> regions where they may be."""
        known = {entry.id: entry for entry in entries}
        clusters = _of_pool(pool_uid, self.clusters.get())
        if any(e.stage in ON_THE_MACHINE and e.id not in clusters for e in known.values()):
            clusters = _of_pool(pool_uid, self.clusters.renew())
        found: dict[ReplicaId, Machine] = {}
        for id, entry in known.items():
            machine = self._of_entry(entry, clusters.get(id))
            if machine is not None:
                found[id] = machine
        for id, cluster in clusters.items():
            if id not in found and id not in self._gone and self.journal.get(id) is None:
                launching = any(request.active for request in self.sky.launches(cluster.name))
                found[id] = of_cluster(id, cluster, launching=launching)
        for instance in self.census.latest(pool_uid, regions):
            if instance.id not in found and self.journal.get(instance.id) is None:
                found[instance.id] = of_instance(instance)
        return [found[id] for id in sorted(found)]

    def refresh(self, id: ReplicaId) -> None:
        """See `Refreshing`."""
        entry = self.journal.get(id)
        alive = None if entry is None else self.census.of(id, entry)
        if entry is not None and alive is not None:
            gone_for_sure = self.clock() - entry.launched_at > PROVIDER_SURE_AFTER_S
            if not alive and gone_for_sure and entry.stage in ON_THE_MACHINE:
                self._gone.add(id)  # SkyPilot still lists it
                self._is_gone(entry)
                self.submit(lambda: self._drop_record(id))
            if all(one.running for one in alive) and (alive or gone_for_sure):
                return
        self.sky.clusters(cluster_name(id), refresh=True)
        self.clusters.forget()

    def _of_entry(self, entry: Entry, cluster: Cluster | None) -> Machine | None:
        alive = None
        if cluster is None and entry.stage in ON_THE_MACHINE:
            alive = self.census.of(entry.id, entry)
            if not alive:
                self._is_gone(entry)
                return None
        return of_entry(entry, cluster, alive[0] if alive else None)

    def _is_gone(self, entry: Entry) -> None:
        log.info("machine_gone replica=%s", entry.id.short)
        self.journal.close(entry.id)
        self.census.forget(entry.id)

    def _drop_record(self, id: ReplicaId) -> None:
        """Have SkyPilot refresh the record of a machine that is gone, so that it drops it."""
        try:
            self.sky.clusters(cluster_name(id), refresh=True)
        except CloudError as error:
            log.warning("record_not_dropped replica=%s reason=%r", id.short, error.message)


def _of_pool(pool_uid: str, clusters: Iterable[Cluster]) -> dict[ReplicaId, Cluster]:
    named = ((replica_of(cluster.name), cluster) for cluster in clusters)
    return {id: cluster for id, cluster in named if id and id.pool_uid == pool_uid}
