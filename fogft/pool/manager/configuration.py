"""The proxies' configurations and certificates, written by the manager.

Owns: the values in `proxy.yaml` and `replica.yaml`, and who gets which certificate.
Not here: reading them (`fogft.proxy.config`) and signing (`credentials`).
"""

import datetime
import os
import re
import socket
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from fogft import disk, template_files
from fogft.cloud.port import Launch
from fogft.model.credentials import NAME_LIMIT, CredentialPaths, Holder, Role, holder_of
from fogft.model.groups import FIRST_BY_HAND, GATEWAY_SLOT
from fogft.model.proxy_config import ClientProxyConfig, RendezvousConfig, ServerProxyConfig
from fogft.model.replica import Offer, ReplicaId
from fogft.model.spec import PoolSpec
from fogft.model.topology import LAUNCHED
from fogft.planning.gateway import resources, version
from fogft.planning.planner import PlannedLaunch
from fogft.pool.credentials import authority
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import Identity
from fogft.pool.manager.reconciler import bare_order
from fogft.poolfile import config_file

_BESIDE = PoolPaths(Path())  # files in the folder of a configuration
_CLIENT_HEADING = (
    "A client proxy, or a gateway. It is read again whenever it changes. Paths are relative to\n"
    "this file's folder; keys not set here have their defaults."
)
_RENDEZVOUS_HEADING = (
    "A rendezvous, for `fogft rendezvous --config`. It needs a port that robots and replicas can\n"
    "reach, and carries no requests. Paths are relative to this file's folder."
)
# If either one ends, `fogft serve` restarts both.
_RUN_GATEWAY = """\
python3 -m fogft rendezvous --config "$FOGFT_FILES/rendezvous.yaml" &
python3 -m fogft gateway --config "$FOGFT_FILES/gateway.yaml" &
wait -n"""
_REPLICA_HEADING = (
    "The server proxy of one replica. Options of `fogft serve` override it. Paths are relative to\n"
    "this file's folder; keys not set here have their defaults."
)


def robot_name() -> str:
    """Return this machine's name in a form valid in certificates."""
    name = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())[:NAME_LIMIT].strip("-")
    return name or "robot"


def write_proxy_config(paths: PoolPaths, identity: Identity, spec: PoolSpec) -> None:
    """Write the client proxy's configuration if it changes."""
    content = proxy_config(identity, spec)
    if disk.read_bytes(paths.proxy_config) != content.encode():
        disk.write_whole(paths.proxy_config, content)


def proxy_config(
    identity: Identity, spec: PoolSpec, *, name: str = "", role: Role = Role.ROBOT
) -> str:
    """Return the configuration of a client proxy or gateway; this machine's without a `name`."""
    config = ClientProxyConfig(
        pool=identity.name,
        pool_uid=identity.uid,
        robot=name or robot_name(),
        membership=_BESIDE.membership,
        status=_BESIDE.proxy_status,
        lock=_BESIDE.proxy_lock,
        credentials=CredentialPaths.of(_BESIDE.credentials, role.value),
        services=spec.proxied,
        suspect_after_s=spec.health.suspect_after_s,
        rendezvous=spec.rendezvous,
        records=_BESIDE.records,
    )
    if role is Role.ROBOT:  # a gateway's replicas hear from the manager through a rendezvous
        config = replace(
            config,
            announcements=_BESIDE.announcements,
            rmw=spec.rmw.robot,
            topics=spec.topics,
        )
    if not name:  # settings of this machine
        door = "" if spec.gateway.launch else spec.dial_in
        config = replace(config, dial_in=door, uplinks=spec.uplinks, metrics=spec.metrics.proxy)
    return config_file.document(config, _CLIENT_HEADING)


def certify_robot(paths: PoolPaths, identity: Identity, now: datetime.datetime) -> None:
    """Ensure that the client proxy has a valid certificate, and its key."""
    revoked = Ledger(paths.credentials).revoked()
    with disk.locked(paths.credentials / "robot.lock"):  # no rotation is under way
        if not authority.is_good(paths.credentials / "robot.crt", now, revoked):
            _rotate(paths, identity)


def rotate_robot(paths: PoolPaths, identity: Identity) -> Holder:
    """Issue new credentials to this machine's client proxy, which switches to them itself."""
    with disk.locked(paths.credentials / "robot.lock"):  # key and certificate are two files
        return _rotate(paths, identity)


def _rotate(paths: PoolPaths, identity: Identity) -> Holder:
    ledger = Ledger(paths.credentials)
    holder, issued = ledger.issue_next(Role.ROBOT, robot_name(), identity.uid)
    authority.write(issued, paths.credentials, "robot")
    return holder


def build_order(
    paths: PoolPaths, identity: Identity, spec: PoolSpec, planned: PlannedLaunch, signed: bytes
) -> Launch:
    """Return the complete order of a planned launch, including the manager's `signed` records."""
    id = ReplicaId(identity.uid, planned.slot, planned.generation)
    holder = holder_of(id.certificate_name)
    issued = Ledger(paths.credentials).issue(holder)
    bare = bare_order(identity, spec, planned)
    config = replica_config(identity, spec, id, announcements=True)
    return replace(
        bare,
        task=with_build(absolute(bare.task, Path(identity.file).parent)),
        files={
            "replica.yaml": config.encode(),
            **issued.files("replica"),
            paths.announcements.name: signed,
        },
    )


def gateway_order(
    paths: PoolPaths,
    identity: Identity,
    spec: PoolSpec,
    offer: Offer,
    generation: int,
    *,
    signed: bytes,
) -> Launch:
    """Return the order of the machine that runs the pool's own gateway and a rendezvous.

    To a cloud it is a replica, which ends with its lease. It offers no service: its `run` starts
    the gateway and the rendezvous. The certificates of earlier gateways are revoked.
    """
    id = ReplicaId(identity.uid, GATEWAY_SLOT, generation)
    ledger = Ledger(paths.credentials)
    mine = Holder(Role.GATEWAY, LAUNCHED, generation, identity.uid)
    ledger.revoke(
        e.holder
        for e in ledger.entries()
        if (e.holder.role, e.holder.name) == (Role.GATEWAY, LAUNCHED) and e.holder != mine
    )
    files = {paths.announcements.name: signed}
    for stem, holder in (
        ("replica", holder_of(id.certificate_name)),
        ("gateway", mine),
        ("rendezvous", replace(mine, role=Role.RENDEZVOUS)),
    ):
        files |= ledger.issue(holder).files(stem)
    listens, rendezvous, door = spec.gateway.endpoints("0.0.0.0")
    near = spec.gateway.endpoints("127.0.0.1")[1]
    gateway = ClientProxyConfig(
        pool=identity.name,
        pool_uid=identity.uid,
        robot=LAUNCHED,
        membership=Path("membership.json"),
        status=Path("gateway-status.json"),
        lock=Path("gateway.lock"),
        credentials=CredentialPaths.of(Path(), "gateway"),
        services=spec.proxied,
        suspect_after_s=spec.health.suspect_after_s,
        rendezvous=(near,),
        records=Path("gateway-records.json"),
        dial_in_listen=door,
        listen=listens,
    )
    meeting = RendezvousConfig(
        identity.uid,
        CredentialPaths.of(Path(), "rendezvous"),
        rendezvous,
        Path("rendezvous-records.json"),
    )
    replica = ServerProxyConfig(
        pool=identity.name,
        pool_uid=identity.uid,
        slot=id.slot,
        generation=generation,
        services=(),
        run=_RUN_GATEWAY,
        credentials=CredentialPaths.of(Path(), "replica"),
        rendezvous=(near,),
        records=Path("records.json"),
        announcements=_BESIDE.announcements,
        rmw=spec.rmw.replica,
    )
    files["replica.yaml"] = config_file.document(replica, _REPLICA_HEADING).encode()
    files["gateway.yaml"] = config_file.document(gateway, _CLIENT_HEADING).encode()
    files["rendezvous.yaml"] = config_file.document(meeting, _RENDEZVOUS_HEADING).encode()
    return Launch(
        id=id,
        pool=identity.name,
        placement=offer.placement,
        usd_per_hour=offer.usd_per_hour,
        spec_hash=version(spec),
        task={"resources": resources(spec)},
        files=files,
        link_port=spec.link_port,
        more_ports=tuple(spec.gateway.port + n for n in range(3)),
    )


def replica_config(
    identity: Identity, spec: PoolSpec, id: ReplicaId, *, announcements: bool = False
) -> str:
    """Return a replica's configuration; `announcements`: a file of signed records comes with it."""
    envs = spec.task.get("envs") or {}
    config = ServerProxyConfig(
        pool=identity.name,
        pool_uid=identity.uid,
        slot=id.slot,
        generation=id.generation,
        services=spec.services,
        run=str(spec.task.get("run") or ""),
        spare=spec.spare,
        credentials=CredentialPaths.of(Path(), "replica"),
        envs={str(k): "" if v is None else str(v) for k, v in envs.items()},
        rendezvous=spec.rendezvous,
        records=Path("records.json"),
        announcements=_BESIDE.announcements if announcements else None,
        dial_out=(spec.dial_in,) if spec.dial_in else (),
        # Replicas that the manager launches may share an address; others have their own.
        metrics=spec.metrics.of_replica(id.slot if id.slot < FIRST_BY_HAND else 0),
        topics=spec.topics,
        rmw=spec.rmw.replica,
    )
    return config_file.document(config, _REPLICA_HEADING)


def rendezvous_config(identity: Identity) -> str:
    """Return a rendezvous's configuration."""
    config = RendezvousConfig(
        identity.uid, CredentialPaths.of(Path(), "rendezvous"), status=Path("status.json")
    )
    return config_file.document(config, _RENDEZVOUS_HEADING)


def absolute(task: Mapping[str, Any], base: Path) -> dict[str, Any]:
    """Return a task whose local paths are absolute: those in a pool file start at its folder."""
    out = dict(task)
    if isinstance(out.get("workdir"), str):
        out["workdir"] = _absolute(out["workdir"], base)
    mounts = out.get("file_mounts")
    if isinstance(mounts, Mapping):
        out["file_mounts"] = {target: _mounted(source, base) for target, source in mounts.items()}
    return out


def _mounted(source: Any, base: Path) -> Any:
    """Return what is mounted, a path or a bucket with one `source` or several, as absolute."""
    if isinstance(source, Mapping) and "source" in source:
        return {**source, "source": _mounted(source["source"], base)}
    if isinstance(source, (list, tuple)):
        return [_mounted(one, base) for one in source]
    return _absolute(source, base) if isinstance(source, str) else source


def _absolute(path: str, base: Path) -> str:
    return path if "://" in path else str((base / os.path.expanduser(path)).resolve())


def with_build(task: Mapping[str, Any]) -> dict[str, Any]:
    """Return a task whose `setup` builds its ROS workspace, if it has one and no `setup`."""
    workdir = None if task.get("setup") else task.get("workdir")
    if isinstance(workdir, str) and any(Path(workdir, "src").rglob("package.xml")):
        return {**task, "setup": (template_files.folder() / "workspace.sh").read_text()}
    return dict(task)
