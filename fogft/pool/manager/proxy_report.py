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
from fogft.model.replica import LinkReport, LinkState, ReplicaId

STALE_S = 5.0


@dataclass(frozen=True)
class ProxyReport:
    """One report of the client proxy.

    Attributes:
        written_at: Seconds since the epoch, by the same machine's clock.
        services: Service name -> its counters, as the proxy wrote them.
        gateways: Name, state, round trip and detail of the links to gateways.
    """

    pid: int
    written_at: float
    robot: str = ""
    uptime_s: float = 0.0
    links: tuple[LinkReport, ...] = ()
    services: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    uplink_suspected: bool = False
    gateways: tuple[Mapping[str, Any], ...] = ()

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
        return ProxyReport(
            pid=int(raw["pid"]),
            written_at=float(raw["written_at"]),
            robot=str(raw.get("robot", "")),
            uptime_s=float(raw.get("uptime_s") or 0.0),
            links=tuple(_link(link, pool_uid) for link in raw["links"]),
            services={str(k): dict(v) for k, v in dict(raw.get("services") or {}).items()},
            uplink_suspected=bool(raw.get("uplink_suspected")),
            gateways=tuple(_gateway(one) for one in raw.get("gateways") or ()),
        )
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError):
        return None


def _gateway(raw: Mapping[str, Any]) -> dict[str, Any]:
    rtt = raw.get("rtt_s")
    return {
        "name": str(raw["name"]),
        "generation": int(raw["generation"]),
        "state": LinkState(raw["state"]).value,
        "rtt_s": None if rtt is None else float(rtt),
        "detail": str(raw.get("detail") or ""),
    }


def _link(raw: Mapping[str, Any], pool_uid: str) -> LinkReport:
    heard, rtt = raw.get("heard_age_s"), raw.get("rtt_s")
    return LinkReport(
        id=ReplicaId(pool_uid, int(raw["slot"]), int(raw["generation"])),
        state=LinkState(raw["state"]),
        ready=frozenset(str(name) for name in raw["ready"]),
        draining=bool(raw.get("draining")),
        at_risk=bool(raw.get("at_risk")),
        disagrees=bool(raw.get("disagrees")),
        heard_age_s=None if heard is None else float(heard),
        silent_for_s=float(raw.get("silent_for_s") or 0.0),
        rtt_s=None if rtt is None else float(rtt),
        in_flight=int(raw.get("in_flight") or 0),
        won=int(raw.get("won") or 0),
        restarts=int(raw.get("restarts") or 0),
        answered=int(raw.get("answered") or 0),
        failed=int(raw.get("failed") or 0),
        detail=str(raw.get("detail") or ""),
        differs=bool(raw.get("differs")),
        offered=tuple(sorted((str(k), str(v)) for k, v in (raw.get("offered") or {}).items())),
    )
