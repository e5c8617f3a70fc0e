"""What is known of a pool now, each part from whoever knows it. Pure.

    status.json (manager) ──► machines, prices, what is wanted ──┐
    proxy-status.json (client proxy) ──► links, counters ────────┼──► Seen
    locks (processes) ──► who lives ─────────────────────────────┘

The manager's copy of what the client proxy reported is not used: it says what was true at the
manager's last look. What nobody has looked at lately is unknown, never as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from fogft.model.replica import LinkReport, LinkState
from fogft.pool.manager.proxy_report import ProxyReport
from fogft.pool.manager.status import PoolStatus

STALE_AFTER_S = 15.0
"""A manager that has not looked for so long knows nothing of now."""


@dataclass(frozen=True)
class Seen:
    """A status with what its reader must know of it.

    Attributes:
        age_s: Since the manager observed the pool; None when it has not yet.
        manager_alive: Whether a manager runs now.
        report_age_s: Since the client proxy reported its links; None for no report.
        links_known: Whether that is recent, and the client proxy runs now.
        answers: Whether a request to each service would be answered now; None for unknown.
        unanswered: The services to which a request would not be.
    """

    status: PoolStatus
    age_s: float | None
    manager_alive: bool
    report_age_s: float | None = None
    links_known: bool = True
    answers: bool | None = None
    unanswered: Sequence[str] = ()

    @property
    def lease_left_s(self) -> float | None:
        """Seconds until the first replica shuts down where no manager runs; None if not known."""
        rows = (*self.status.replicas, *self.status.by_hand)
        known = [one.lease_left_s for one in rows if one.lease_left_s is not None]
        return min(known, default=None)

    @property
    def stale(self) -> bool:
        """Whether what the manager last saw says nothing of now."""
        return self.age_s is None or self.age_s > STALE_AFTER_S

    def to_json(self) -> dict[str, Any]:
        """Return `status.json`'s schema with the keys that this adds."""
        own = {name: value for name, value in vars(self).items() if name != "status"}
        return {**self.status.to_json(), **own, "unanswered": list(self.unanswered)}


def current(
    status: PoolStatus,
    report: ProxyReport | None,
    *,
    manager_alive: bool,
    proxy_alive: bool,
    now: float,
    heard_since: float | None = None,
) -> Seen:
    """Return what is known now.

    Args:
        heard_since: Only a link whose replica has answered a probe since then counts as up;
            None for what the report says.
    """
    fresh = report if proxy_alive and report is not None and report.fresh(now) else None
    links = fresh.links if fresh is not None else None
    if fresh is not None and heard_since is not None:
        links = tuple(_heard(k, fresh.written_at, heard_since) for k in fresh.links)
    age_s = max(0.0, now - status.observed_at) if status.observed_at else None
    seen = Seen(
        status,
        age_s,
        manager_alive,
        None if report is None else max(0.0, now - report.written_at),
        links_known=fresh is not None,
    )
    found = status.joined(report, proxy_alive=proxy_alive, links=links, stale=seen.stale)
    found = replace(found, uplink_suspected=fresh is not None and fresh.uplink_suspected)
    services = found.services
    silent = [one.name for one in services if not one.ready_replicas]
    hangs = proxy_alive and fresh is None
    answers = None if hangs or not services else proxy_alive and not silent
    return replace(seen, status=found, answers=answers, unanswered=() if hangs else silent)


def _heard(link: LinkReport, written_at: float, since: float) -> LinkReport:
    heard_at = -1.0 if link.heard_age_s is None else written_at - link.heard_age_s
    if link.state is LinkState.UP and heard_at < since:
        return replace(link, state=LinkState.SUSPECT, detail="it did not answer a probe in time")
    return link
