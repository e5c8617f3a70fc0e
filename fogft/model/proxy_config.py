"""What the proxies' configuration files hold. Values only; relative paths begin at the file.

Owns: the keys of `proxy.yaml`, `gateway.yaml` and `replica.yaml`.
Not here: reading them (`fogft.proxy.config`), writing them (`fogft.pool.manager.configuration`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fogft.model.choices import Speaks
from fogft.model.credentials import CredentialPaths
from fogft.model.keys import (
    PATH,
    Flag,
    Free,
    Listed,
    Map,
    Maps,
    Number,
    OneOf,
    Text,
    Whole,
    key,
    only,
)
from fogft.model.names import NOTICE_SOURCES, POOL_UID_PATTERN, ROBOT_BYTES_LIMIT, is_endpoint
from fogft.model.replica import ReplicaId
from fogft.model.spec import ServiceSpec
from fogft.model.topic import TopicSpec
from fogft.model.uplinks import is_interface

_LAST_GENERATION = 1 << 31


def _is_robot(written: str) -> bool:
    return written.isprintable() and 0 < len(written.encode()) <= ROBOT_BYTES_LIMIT


def _is_notice_source(written: str) -> bool:
    kind, _, path = written.partition(":")
    return (kind == "file" and path != "") or written in ("none", *NOTICE_SOURCES)


_POOL = Text("a pool's name", "write the pool's name")
_UID = Text("a pool's uid", "quote its 16 hexadecimal digits", only(POOL_UID_PATTERN.fullmatch))
_ENDPOINT = Text("`host:port`", "write an address and a port", only(is_endpoint))
_ENDPOINTS = Listed(_ENDPOINT, 64, least=0)
_MAPS = "write a list of maps"


@dataclass(frozen=True)
class ClientProxyConfig:
    """All that `fogft proxy` or `fogft gateway` needs to know."""

    pool: str = key(_POOL, "Name of the pool.")
    pool_uid: str = key(_UID, "The pool's identity.")
    robot: str = key(
        Text("a name", f"write 1 to {ROBOT_BYTES_LIMIT} printable bytes", only(_is_robot)),
        "Name of this robot, or gateway.",
    )
    membership: Path = key(PATH, "Which replicas there are; written by the manager.")
    status: Path = key(PATH, "What the proxy reports to the manager.")
    lease: Path = key(PATH, "Its beat tells that a manager lives.")
    lock: Path = key(PATH, "Held while the proxy lives.")
    credentials: CredentialPaths = key(Map(CredentialPaths), "Certificate, key and CA.")
    services: tuple[ServiceSpec, ...] = key(Maps(ServiceSpec, _MAPS), "The proxied services.")
    suspect_after_s: float = key(
        Number(3600, "seconds"),
        "Send nothing more to a replica after this long without a probe reply.",
        default=2.0,
    )
    tell_losers: bool = key(
        Flag(),
        "Tell replicas which requests were answered elsewhere.",
        default=True,
    )
    domain_id: int | None = key(
        Whole(0, 232), "ROS domain; ROS_DOMAIN_ID where it is not set.", default=None
    )
    rendezvous: tuple[str, ...] = key(_ENDPOINTS, "Where rendezvous listen.", default=())
    records: Path | None = key(
        PATH, "What was learned from rendezvous, for the next start.", default=None
    )
    revocations: Path | None = key(
        PATH, "The manager's signed revocations, to be passed on to replicas.", default=None
    )
    dial_in: str = key(
        _ENDPOINT, "Address that replicas which cannot be reached are given.", default=""
    )
    dial_in_listen: str = key(
        _ENDPOINT, "Where to listen for them, if not on that port of all addresses.", default=""
    )
    uplinks: tuple[str, ...] = key(
        Listed(
            Text("a network interface's name", "write what `ip link` lists", only(is_interface)),
            64,
            0,
        ),
        "Network interfaces to use at once, the preferred one first.",
        default=(),
    )
    metrics: str = key(_ENDPOINT, "Where to answer Prometheus.", default="")
    topics: tuple[TopicSpec, ...] = key(Maps(TopicSpec, _MAPS), "The proxied topics.", default=())
    rmw: Speaks = key(OneOf(Speaks), "How the proxy speaks ROS.", default=Speaks.RCLPY)
    listen: str = key(_ENDPOINT, "Where a gateway listens for robots.", default="")


@dataclass(frozen=True)
class ServerProxyConfig:
    """All that `fogft serve` needs to know. Its options override the file."""

    pool: str = key(_POOL, "Name of the pool.")
    pool_uid: str = key(_UID, "The pool's identity.")
    slot: int = key(Whole(0, 999_999), "Slot of this replica.")
    generation: int = key(Whole(1, _LAST_GENERATION), "Which launch of the slot this is.")
    services: tuple[ServiceSpec, ...] = key(Maps(ServiceSpec, _MAPS), "The proxied services.")
    credentials: CredentialPaths = key(Map(CredentialPaths), "Certificate, key and CA.")
    run: str = key(
        Text("a command", "write the command that starts the services"),
        "Command that starts the services; none where they are started otherwise.",
        default="",
    )
    listen: str = key(_ENDPOINT, "Where to listen.", default="0.0.0.0:7447")
    workdir: Path = key(PATH, "Folder in which `run` starts.", default=Path())
    envs: Mapping[str, str] = key(
        Free("write a map of texts"), "Environment of `run`.", default_factory=dict
    )
    domain_id: int | None = key(
        Whole(0, 232), "ROS domain; ROS_DOMAIN_ID where it is not set.", default=None
    )
    orphan_after_s: float = key(
        Number(1e7, "seconds"),
        "Shut down after this long without a sign of a manager.",
        default=3600.0,
    )
    notice: str = key(
        Text(
            "a source of notices",
            f"write one of file:PATH, none, {', '.join(NOTICE_SOURCES)}",
            only(_is_notice_source),
        ),
        "Where preemption notices come from.",
        default="auto",
    )
    max_in_flight: int = key(Whole(1, 1 << 20), "Most requests held at once.", default=512)
    log_level: str = key(
        Text("a log level", "write debug, info, warning or error"), "Log level.", default="info"
    )
    advertise: str = key(
        _ENDPOINT, "Address at which this replica is reached, where it differs.", default=""
    )
    rendezvous: tuple[str, ...] = key(_ENDPOINTS, "Where rendezvous listen.", default=())
    records: Path | None = key(
        PATH, "What was learned from rendezvous, for the next start.", default=None
    )
    dial_out: tuple[str, ...] = key(
        _ENDPOINTS, "Robots that this replica dials, where it cannot be reached.", default=()
    )
    metrics: str = key(_ENDPOINT, "Where to answer Prometheus.", default="")
    topics: tuple[TopicSpec, ...] = key(Maps(TopicSpec, _MAPS), "The proxied topics.", default=())
    rmw: Speaks = key(OneOf(Speaks), "How the proxy speaks ROS.", default=Speaks.RCLPY)

    @property
    def id(self) -> ReplicaId:
        """Which replica this is."""
        return ReplicaId(self.pool_uid, self.slot, self.generation)


@dataclass(frozen=True)
class RendezvousConfig:
    """All that `fogft rendezvous` needs to know."""

    pool_uid: str = key(_UID, "The pool's identity.")
    credentials: CredentialPaths = key(Map(CredentialPaths), "Certificate, key and CA.")
    listen: str = key(_ENDPOINT, "Where to listen.", default="0.0.0.0:7450")
    records: Path = key(PATH, "File that keeps the records.", default=Path("records.json"))
    status: Path | None = key(PATH, "File for what was counted.", default=None)
    metrics: str = key(_ENDPOINT, "Where to answer Prometheus.", default="")
