"""One machine, out of what the journal, SkyPilot and the provider each say of it. Pure.

SkyPilot's list decides what exists; the journal says what a launch is waiting for and why it
failed; the provider is heard where SkyPilot is silent.
"""

from __future__ import annotations

from dataclasses import replace

from fogft.cloud.sky import naming
from fogft.cloud.sky.journal import Entry, Stage
from fogft.cloud.sky.provider import Instance
from fogft.cloud.sky.sdk import Cluster, ClusterState
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Machine, MachinePhase, Placement, ReplicaId

NOWHERE = Placement("", "", "", "")


def of_entry(entry: Entry, cluster: Cluster | None, instance: Instance | None) -> Machine:
    """Return a machine that the journal knows; the others may say nothing of it."""
    phase, failure, progress = MachinePhase.PROVISIONING, entry.failure, entry.stage.value
    if entry.stage is Stage.ENDING:
        # Listed until it is certain that nothing runs, so that a crash in between is repaired.
        failure = failure or _error("its end was not confirmed")
    elif entry.stage is not Stage.FAILED and cluster and cluster.state is ClusterState.STOPPED:
        failure = _error("the machine was stopped")
    if failure is not None:
        phase, progress = MachinePhase.FAILED, ""
    elif entry.stage is Stage.SETTING_UP:
        phase = MachinePhase.RUNNING  # the machine runs; its services do not answer yet
    elif entry.stage is Stage.RUNNING:
        phase, progress = MachinePhase.RUNNING, ""
    elif cluster is not None:
        progress = cluster.progress or progress
    placement = entry.placement
    if cluster is not None and cluster.placement is not None:
        placement = _as_found(entry, cluster.placement)
    ip = (cluster.head_ip if cluster else "") or (instance.public_ip if instance else "")
    return Machine(
        id=entry.id,
        placement=placement,
        phase=phase,
        launched_at=entry.launched_at,
        endpoint=_endpoint(entry, ip) if phase is not MachinePhase.FAILED else None,
        usd_per_hour=entry.instead.get(placement.instance, entry.usd_per_hour),
        spec_hash=entry.spec_hash,
        failure=failure,
        progress=progress,
        setting_up=phase is MachinePhase.RUNNING and entry.stage is Stage.SETTING_UP,
        running_at=entry.running_at,
        set_up_at=entry.set_up_at,
        pool=cluster.labels.get(naming.NAME, "") if cluster else "",
    )


def of_cluster(id: ReplicaId, cluster: Cluster, *, launching: bool) -> Machine:
    """Return a machine that SkyPilot lists and the journal has lost."""
    phase, failure = MachinePhase.FAILED, None
    if cluster.state is ClusterState.UP:
        phase = MachinePhase.RUNNING
    elif launching:
        phase = MachinePhase.PROVISIONING
    else:
        said = f"SkyPilot says {cluster.state.value}: {cluster.progress or 'no reason'}"
        failure = _error(said)
    cloud = cluster.placement.cloud if cluster.placement else ""
    known = cluster.head_ip and cloud not in naming.MAPPING_CLOUDS
    running = phase is MachinePhase.RUNNING and known
    return Machine(
        id=id,
        placement=cluster.placement or NOWHERE,
        phase=phase,
        launched_at=cluster.launched_at,
        endpoint=f"{cluster.head_ip}:{naming.link_port(cluster.labels)}" if running else None,
        usd_per_hour=naming.usd_per_hour(cluster.labels),
        spec_hash=cluster.labels.get(naming.SPEC, ""),
        failure=failure,
        progress=cluster.progress if phase is MachinePhase.PROVISIONING else "",
        pool=cluster.labels.get(naming.NAME, ""),
    )


def of_instance(instance: Instance) -> Machine:
    """Return a machine that only the provider knows: nobody can use it, so it is to go."""
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
    if entry.placement.cloud in naming.MAPPING_CLOUDS and entry.port:
        return entry.endpoint or None
    return f"{ip}:{entry.port}" if ip else None


def _error(words: str) -> Reason:
    return Reason(Cause.ERROR, words=words)


def _as_found(entry: Entry, found: Placement) -> Placement:
    """Keep what was ordered, but for a zone that the cloud has chosen, and a type in its place."""
    asked = entry.placement
    if (asked.cloud, asked.region) != (found.cloud, found.region):
        return asked
    instance = found.instance if found.instance in entry.instead else asked.instance
    return replace(asked, zone=asked.zone or found.zone, instance=instance)
