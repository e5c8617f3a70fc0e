"""The client proxy's report. An old or damaged report counts as unknown.

Owns: `proxy-status.json` as the manager sees it.
Not here: writing it (`fogft.proxy.robot.process`) and judging it
(`fogft.planning.observed.health`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from fogft import disk
from fogft.errors import StateError
from fogft.model.plain import Count, Line, Moment, Seconds, from_plain
from fogft.model.replica import LinkReport, LinkState

STALE_S = 5.0


@dataclass(frozen=True)
class GatewayLink:
    """The state of the robot's link to a gateway."""

    name: str
    generation: int
    state: LinkState
    rtt_s: Seconds | None = None
    detail: str = ""


@dataclass(frozen=True)
class _Order:
    trouble: str = ""


@dataclass(frozen=True)
class Counted:
    """The counters of a service that are shown to people."""

    received: Count = 0
    answered: Count = 0
    fallback: Count = 0
    silent: Count = 0
    empty: Count = 0
    turned_away: Count = 0
    poison: Count = 0
    late: Count = 0
    request_bytes: Count = 0
    response_bytes: Count = 0
    pending: Count = 0
    needed_replicas: Count = 0
    quorum: Count = 1
    poisoned_at: Moment | None = None
    p50_s: Seconds | None = None
    p99_s: Seconds | None = None
    order: _Order | None = None
    trouble: str = ""


Counters = Annotated[Mapping[str, Any], partial(from_plain, Counted)]


@dataclass(frozen=True)
class TopicCounted:
    """The counters of a topic's messages.

    Attributes:
        messages: Published by the robot's nodes, or by replicas' nodes (each replica counts).
        passed: Published on the other side; for the robot's messages, by at least one replica.
        dropped: Too many for a replica, or a copy of another replica's message.
        trouble: Why no messages pass; empty while they can.
    """

    messages: Count = 0
    passed: Count = 0
    dropped: Count = 0
    refused: Count = 0
    rate_hz: Seconds = 0.0
    trouble: str = ""


@dataclass(frozen=True)
class ProxyReport:
    """One report of the client proxy.

    Attributes:
        written_at: Seconds since the epoch, by the same machine's clock.
        services: Service name -> its counters, as the proxy wrote them.
        manager_epoch: The newest manager epoch that it has heard of, of this machine or another.
    """

    pid: int
    written_at: Moment
    robot: str = ""
    version: Line = ""
    uptime_s: float = 0.0
    links: tuple[LinkReport, ...] = ()
    services: Mapping[str, Counters] = field(default_factory=dict)
    topics: Mapping[str, TopicCounted] = field(default_factory=dict)
    uplink_suspected: bool = False
    gateways: tuple[GatewayLink, ...] = ()
    manager_epoch: Count = 0

    def fresh(self, now: float) -> bool:
        """Whether the report is recent. After a clock jump it is not."""
        return abs(now - self.written_at) <= STALE_S

    def digest(self) -> object:
        """Return the fields that a manager reacts to at once, without counters and ages."""
        return frozenset(
            (k.id, k.state, k.doubted, k.ready, k.leaving, k.at_risk, k.disagrees, k.offered)
            for k in self.links
        )


def read(path: Path, pool_uid: str) -> ProxyReport | None:
    """Return the last report; None if there is none or it is damaged."""
    try:
        return parse(disk.read_json(path), pool_uid)
    except StateError:
        return None


def parse(raw: Any, pool_uid: str) -> ProxyReport | None:
    """Return a report from its JSON value, or None for anything else."""
    try:
        links = [_with_id(link, pool_uid) for link in raw["links"]]
        return from_plain(ProxyReport, {**raw, "links": links})
    except (KeyError, TypeError, ValueError, AttributeError):
        return None


def _with_id(link: Mapping[str, Any], pool_uid: str) -> dict[str, Any]:
    id = {"pool_uid": pool_uid, "slot": link["slot"], "generation": link["generation"]}
    offered = sorted(map(list, link.get("offered", {}).items()))
    return {**link, "id": id, "offered": offered}
