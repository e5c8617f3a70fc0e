"""The proxies' configuration files. Values only; paths are relative to the file."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from fogft.model.choices import Speaks, is_interface
from fogft.model.credentials import CredentialPaths
from fogft.model.keys import LONGEST_S, only
from fogft.model.names import (
    LINK_PORT,
    NOTICE_SOURCES,
    ROBOT_BYTES_LIMIT,
    Endpoint,
    EndpointOrEmpty,
    PoolUid,
)
from fogft.model.plain import Generation, within
from fogft.model.replica import ReplicaId
from fogft.model.spec import ServiceSpec
from fogft.model.topic import TopicSpec


def _is_robot(written: str) -> bool:
    return written.isprintable() and 0 < len(written.encode()) <= ROBOT_BYTES_LIMIT


def _is_notice_source(written: str) -> bool:
    kind, _, path = written.partition(":")
    return (kind == "file" and path != "") or written in ("none", *NOTICE_SOURCES)


_sources = f"one of file:PATH, none, {', '.join(NOTICE_SOURCES)}"
Robot = Annotated[str, only(_is_robot, f"1 to {ROBOT_BYTES_LIMIT} printable bytes")]
NoticeSource = Annotated[str, only(_is_notice_source, _sources)]
Interface = Annotated[str, only(is_interface, "a network interface's name")]
DomainId = Annotated[int, within(0, 232)]
LastsFor = Annotated[float, within(1e-12, LONGEST_S)]


@dataclass(frozen=True, kw_only=True)
class ProxyConfig:
    """Configuration common to all proxies.

    Attributes:
        domain_id: ROS domain; ROS_DOMAIN_ID where it is not set.
        records: What was learned from rendezvous, for the next start.
        announcements: What the manager signed for every replica.
    """

    pool: str
    pool_uid: PoolUid
    credentials: CredentialPaths
    services: tuple[ServiceSpec, ...]
    domain_id: DomainId | None = None
    rendezvous: tuple[Endpoint, ...] = ()
    records: Path | None = None
    announcements: Path | None = None
    metrics: EndpointOrEmpty = ""
    topics: tuple[TopicSpec, ...] = ()
    rmw: Speaks = Speaks.RCLPY


@dataclass(frozen=True, kw_only=True)
class ClientProxyConfig(ProxyConfig):
    """Configuration of `fogft proxy` and `fogft gateway`, which passes `announcements` on.

    Attributes:
        robot: Name of this robot, or gateway.
        membership: Which replicas there are; written by the manager.
        status: What the proxy reports to the manager.
        suspect_after_s: Nothing more is sent to a replica after so long without a probe reply.
        tell_losers: Whether replicas are told which requests were answered elsewhere.
        dial_in: Address that replicas which cannot be reached are given; `dial_in_listen` is where
            to listen for them, if not on that port of all addresses.
        uplinks: Network interfaces to use at once, the preferred one first.
        listen: Where a gateway listens for robots.
    """

    robot: Robot
    membership: Path
    status: Path
    lock: Path
    suspect_after_s: LastsFor = 2.0
    tell_losers: bool = True
    dial_in: EndpointOrEmpty = ""
    dial_in_listen: EndpointOrEmpty = ""
    uplinks: tuple[Interface, ...] = ()
    listen: EndpointOrEmpty = ""


@dataclass(frozen=True, kw_only=True)
class ServerProxyConfig(ProxyConfig):
    """Configuration of `fogft serve`, whose options override the file.

    Attributes:
        run: Command that starts the services in `workdir`; empty where they are started otherwise.
        spare: Whether a second process of it is kept, which takes over when the first dies.
        notice: Where preemption notices come from.
        advertise: Address at which this replica is reached, where it differs.
        dial_out: Robots that this replica dials, where it cannot be reached.
    """

    slot: Annotated[int, within(0, 999_999)]
    generation: Generation
    run: str = ""
    spare: bool = False
    listen: Endpoint = f"0.0.0.0:{LINK_PORT}"
    workdir: Path = Path()
    envs: Mapping[str, str] = field(default_factory=dict)
    notice: NoticeSource = "auto"
    advertise: EndpointOrEmpty = ""
    dial_out: tuple[Endpoint, ...] = ()

    @property
    def id(self) -> ReplicaId:
        """Which replica this is."""
        return ReplicaId(self.pool_uid, self.slot, self.generation)


@dataclass(frozen=True)
class RendezvousConfig:
    """Configuration of `fogft rendezvous`."""

    pool_uid: PoolUid
    credentials: CredentialPaths
    listen: Endpoint = "0.0.0.0:7450"
    records: Path = Path("records.json")
    status: Path | None = None
    metrics: EndpointOrEmpty = ""
