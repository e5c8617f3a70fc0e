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
    """Configuration common to all proxies."""

    pool: str
    pool_uid: PoolUid
    credentials: CredentialPaths
    services: tuple[ServiceSpec, ...]
    domain_id: DomainId | None = None  # ROS domain; if not set, ROS_DOMAIN_ID
    rendezvous: tuple[Endpoint, ...] = ()
    records: Path | None = None  # records learned from rendezvous, for the next start
    announcements: Path | None = None  # signed by the manager for every replica
    metrics: EndpointOrEmpty = ""
    topics: tuple[TopicSpec, ...] = ()
    rmw: Speaks = Speaks.RCLPY

    def __post_init__(self) -> None:
        if self.rmw is Speaks.ZENOH and self.topics:
            raise ValueError("`rmw: zenoh` supports only services, no topics")


@dataclass(frozen=True, kw_only=True)
class ClientProxyConfig(ProxyConfig):
    """Configuration of `fogft proxy`, and of `fogft gateway`, which forwards `announcements`."""

    robot: Robot  # the name of this robot or gateway
    membership: Path  # the list of replicas, written by the manager
    status: Path  # the proxy's report to the manager
    lock: Path
    suspect_after_s: LastsFor = 2.0  # then a replica without a probe reply gets no requests
    tell_losers: bool = True  # whether replicas are told which requests were answered elsewhere
    dial_in: EndpointOrEmpty = ""  # address given to replicas that cannot be reached
    dial_in_listen: EndpointOrEmpty = ""  # where to listen, if not on that port of all addresses
    uplinks: tuple[Interface, ...] = ()  # used at the same time, preferred first
    listen: Endpoint = "0.0.0.0:7470"  # where a gateway listens for robots


@dataclass(frozen=True, kw_only=True)
class ServerProxyConfig(ProxyConfig):
    """Configuration of `fogft serve`, whose options override the file."""

    slot: Annotated[int, within(0, 999_999)]
    generation: Generation
    run: str = ""  # command that starts the services, in `workdir`; empty if something else does
    spare: bool = False  # whether to keep a second `run` process for when the first dies
    listen: Endpoint = f"0.0.0.0:{LINK_PORT}"
    workdir: Path = Path()
    envs: Mapping[str, str] = field(default_factory=dict)
    notice: NoticeSource = "auto"
    advertise: EndpointOrEmpty = ""  # address at which this replica is reached, if not `listen`
    dial_out: tuple[Endpoint, ...] = ()  # robots that it dials, if it cannot be reached

    @property
    def id(self) -> ReplicaId:
        """The id of this replica."""
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
