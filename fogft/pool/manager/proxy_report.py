"""Read what the client proxy reports. An old or damaged report means: nothing is known.

Owns: `proxy-status.json` as the manager sees it.
Not here: writing it (`fogft.proxy.robot.process`) and judging it
(`fogft.planning.observed.health`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fogft import disk
from fogft.errors import StateError
from fogft.model.plain import Seconds, from_plain
from fogft.model.replica import LinkReport, LinkState

STALE_S = 5.0


@dataclass(frozen=True)
class GatewayLink:
    """How the robot's link to a gateway does."""

    name: str
    generation: int
    state: LinkState
    rtt_s: Seconds | None = None
    detail: str = ""


@dataclass(frozen=True)
class ProxyReport:
    """One report of the client proxy.

    Attributes:
        written_at: Seconds since the epoch, by the same machine's clock.
        services: Service name -> its counters, as the proxy wrote them.
    """

    pid: int
    written_at: float
    robot: str = ""
    uptime_s: float = 0.0
    links: tuple[LinkReport, ...] = ()
    services: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    uplink_suspected: bool = False
    gateways: tuple[GatewayLink, ...] = ()

    def fresh(self, now: float) -> bool:
        """Whether it still says something about now. A clock that jumped makes it say nothing."""
        return abs(now - self.written_at) <= STALE_S

    def digest(self) -> object:
        """Return what a manager should react to at once; counters and ages are left out."""
        return frozenset(
            (k.id, k.state, k.doubted, k.ready, k.draining, k.at_risk, k.disagrees, k.offered)
            for k in self.links
        )


def read(path: Path, pool_uid: str) -> ProxyReport | None:
    """Return the last report, or None where there is none or it is damaged."""
    try:
        raw = disk.read_json(path)
    except StateError:
        return None
    return None if raw is None else parse(raw, pool_uid)


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
