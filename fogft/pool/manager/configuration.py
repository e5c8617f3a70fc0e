"""What the manager writes for the proxies: their configurations and certificates.

Owns: the values in `templates/proxy.yaml` and `templates/replica.yaml`, and who gets which
certificate.
Not here: reading them (`fogft.proxy.config`) and signing (`credentials`).
"""

from __future__ import annotations

import datetime
import re
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fogft import disk, template_files
from fogft.cloud.port import Launch
from fogft.errors import CredentialError
from fogft.model import certificate_holder
from fogft.model.certificate_holder import Holder, holder_of
from fogft.model.groups import FIRST_BY_HAND, replica_hash, services_at, task_at
from fogft.model.replica import ReplicaId
from fogft.model.spec import PoolSpec
from fogft.planning.planner import PlannedLaunch
from fogft.pool.credentials import authority
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import Identity
from fogft.poolfile import workspace
from fogft.poolfile.service_form import REPLICA_KEYS, to_plain

# A dead manager renews nothing and must stop no traffic.
CERTIFICATE_DAYS = 365.0
# What a certificate lasts beyond the end of a pool that has one.
MARGIN_DAYS = 30.0
RENEW_BEFORE = datetime.timedelta(days=60)


def certificate_days(spec: PoolSpec) -> float:
    """Return how long a certificate lasts: a year, and a month more than `max_hours`."""
    return max(CERTIFICATE_DAYS, (spec.max_hours or 0.0) / 24 + MARGIN_DAYS)


def robot_name() -> str:
    """Return this machine's name, fit for a certificate."""
    name = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())[
        : certificate_holder.NAME_LIMIT
    ].strip("-")
    return name or "robot"


def write_proxy_config(paths: PoolPaths, identity: Identity, spec: PoolSpec) -> bool:
    """Bring the client proxy's configuration up to date; return whether it changed.

    Raises:
        StateError: It cannot be written.
    """
    content = proxy_config(paths, identity, spec)
    if paths.proxy_config.exists() and paths.proxy_config.read_text() == content:
        return False
    disk.write_whole(paths.proxy_config, content)
    return True


def proxy_config(
    paths: PoolPaths,
    identity: Identity,
    spec: PoolSpec,
    *,
    robot: str = "",
    stem: str = "robot",
    file: str = "proxy.yaml",
) -> str:
    """Return a client proxy's configuration, or a gateway's.

    Args:
        paths: How its files are called; where they are does not matter.
        identity: The pool.
        spec: Its services.
        robot: The robot's name; empty for this machine's.
        stem: How its certificate and key are called.
        file: The template.
    """
    return template_files.render(
        file,
        {
            "pool": identity.name,
            "pool_uid": identity.uid,
            "robot": robot or robot_name(),
            "membership": paths.membership.name,
            "status": paths.proxy_status.name,
            "lease": paths.lease.name,
            "lock": paths.proxy_lock.name,
            "ca": f"{paths.credentials.name}/ca.crt",
            "certificate": f"{paths.credentials.name}/{stem}.crt",
            "key": f"{paths.credentials.name}/{stem}.key",
            "services": [to_plain(service) for service in spec.proxied],
            "suspect_after_s": spec.health.suspect_after_s,
            "rendezvous": list(spec.rendezvous),
            "records": paths.records.name,
            # A gateway's replicas hear of revocations from a rendezvous.
            **(
                {
                    "revocations": paths.revocations.name,
                    "rmw": spec.rmw.robot.value,
                    "topics": [topic.to_plain() for topic in spec.topics],
                }
                if file == "proxy.yaml"
                else {}
            ),
            "dial_in": "" if robot else spec.dial_in,  # that is where this machine is
            "uplinks": [] if robot else list(spec.uplinks),  # and these are its own
            "metrics": "" if robot else spec.metrics.proxy,
        },
    )


def certify_robot(
    paths: PoolPaths, identity: Identity, spec: PoolSpec, now: datetime.datetime
) -> bool:
    """See to it that the client proxy has a certificate that is good; return whether it is new.

    Raises:
        CredentialError: The pool's CA cannot be used.
    """
    ledger = Ledger(paths.credentials)
    try:
        said = authority.describe(paths.credentials / "robot.crt")
        holder = holder_of(said.common_name)
        revoked = holder.common_name in ledger.revoked()
        if not revoked and not said.problem(now + RENEW_BEFORE):
            return False
    except (CredentialError, ValueError):
        pass  # there is none yet, or it is damaged: a new one is issued
    rotate_robot(paths, identity, spec)
    return True


def rotate_robot(paths: PoolPaths, identity: Identity, spec: PoolSpec) -> Holder:
    """Give this machine's client proxy new credentials; it takes them into use by itself.

    Raises:
        CredentialError: The pool's CA cannot be used.
        StateError: They cannot be written; the old ones stay.
    """
    holder, issued = Ledger(paths.credentials).issue_next(
        certificate_holder.Role.ROBOT, robot_name(), identity.uid, days=certificate_days(spec)
    )
    authority.write(issued, paths.credentials, "robot")
    return holder


def build_order(
    paths: PoolPaths, identity: Identity, spec: PoolSpec, planned: PlannedLaunch
) -> Launch:
    """Return the order of a planned launch, with all that its server proxy needs.

    Raises:
        CredentialError: The pool's CA cannot be used.
    """
    id = ReplicaId(identity.uid, planned.slot, planned.generation)
    holder = holder_of(id.certificate_name)
    issued = Ledger(paths.credentials).issue(holder, days=certificate_days(spec))
    return Launch(
        id=id,
        pool=identity.name,
        placement=planned.offer.placement,
        usd_per_hour=planned.offer.usd_per_hour,
        spec_hash=replica_hash(spec, id.slot),
        task=workspace.with_build(absolute(task_at(spec, id.slot), Path(identity.file).parent)),
        files={
            "replica.yaml": replica_config(identity, spec, id).encode(),
            "ca.crt": issued.authority_pem,
            "replica.crt": issued.certificate_pem,
            "replica.key": issued.key_pem,
        },
        dials_out=bool(spec.dial_in),
    )


def replica_config(identity: Identity, spec: PoolSpec, id: ReplicaId) -> str:
    """Return a replica's configuration. Address, domain and folder are the machine's to add."""
    services = services_at(spec, id.slot)
    envs: dict[str, Any] = dict(spec.task.get("envs") or {})
    if services != spec.services:  # `run` need not start the others
        envs.setdefault("FOGFT_SERVICES", ",".join(service.name for service in services))
    return template_files.render(
        "replica.yaml",
        {
            "pool": identity.name,
            "pool_uid": identity.uid,
            "slot": id.slot,
            "generation": id.generation,
            "services": [to_plain(service, REPLICA_KEYS) for service in services],
            "topics": [topic.to_plain() for topic in spec.topics],
            "run": str(spec.task.get("run") or ""),
            "envs": {str(k): "" if v is None else str(v) for k, v in envs.items()},
            "orphan_after_s": spec.health.orphan_after_s,
            "rendezvous": list(spec.rendezvous),
            "dial_out": [spec.dial_in] if spec.dial_in else [],
            # Those that the manager launches may share an address; others have one of their own.
            "metrics": spec.metrics.of_replica(id.slot if id.slot < FIRST_BY_HAND else 0),
            "rmw": spec.rmw.replica.value,
        },
    )


def absolute(task: Mapping[str, Any], base: Path) -> dict[str, Any]:
    """Return a task whose local paths no longer depend on where a process runs.

    Relative paths in a pool file are relative to the file's own folder.
    """
    out = dict(task)
    if isinstance(out.get("workdir"), str):
        out["workdir"] = _absolute(out["workdir"], base)
    mounts = out.get("file_mounts")
    if isinstance(mounts, Mapping):
        out["file_mounts"] = {
            target: _absolute(source, base) if isinstance(source, str) else source
            for target, source in mounts.items()
        }
    return out


def _absolute(path: str, base: Path) -> str:
    return path if "://" in path else str((base / Path(path).expanduser()).resolve())
