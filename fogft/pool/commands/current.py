"""What is known of a pool now, each part from whoever knows it. Pure.

    status.json (manager) ──► machines, prices, what is wanted ──┐
    proxy-status.json (client proxy) ──► links, counters ────────┼──► Seen
    locks (processes) ──► who lives ─────────────────────────────┘

The manager's copy of what the client proxy reported is not used: it says what was true at the
manager's last look. What nobody has looked at lately is unknown, never as it was.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from fogft.model.replica import LinkReport, LinkState, Phase
from fogft.pool.manager.proxy_report import ProxyReport
from fogft.pool.manager.status import PoolStatus, ReplicaStatus

STALE_AFTER_S = 15.0
"""A manager that has not looked for so long knows nothing of now."""
_COMING = (Phase.PROVISIONING.value, Phase.STARTING.value)
_Links = Mapping[tuple[int, int], LinkReport]


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
        status: What the manager saw last.
        report: The client proxy's last report.
        manager_alive: Whether the manager's lock is held.
        proxy_alive: Whether the client proxy's is.
        now: Seconds since the epoch.
        heard_since: Only a link whose replica has answered a probe since then counts as up;
            None for what the report says.
    """
    fresh = report if proxy_alive and report is not None and report.fresh(now) else None
    links = {(k.id.slot, k.id.generation): k for k in fresh.links} if fresh is not None else {}
    if fresh is not None and heard_since is not None:
        links = {key: _heard(k, fresh.written_at, heard_since) for key, k in links.items()}
    age_s = max(0.0, now - status.observed_at) if status.observed_at else None
    seen = Seen(
        status,
        age_s,
        manager_alive,
        None if report is None else max(0.0, now - report.written_at),
        links_known=fresh is not None,
    )
    counters = report.services if report is not None else {}
    services = [
        replace(
            one,
            ready_replicas=sum(_answers(k, one.name) for k in links.values()),
            counters=counters.get(one.name, one.counters),
        )
        for one in status.services
    ]
    replicas = [_now(one, links, seen) for one in status.replicas]
    found = replace(
        status,
        proxy_alive=proxy_alive,
        proxy_version=report.version if report is not None and proxy_alive else "",
        proxy_pid=report.pid if report is not None and proxy_alive else None,
        uplink_suspected=fresh is not None and fresh.uplink_suspected,
        replicas=replicas,
        by_hand=[_now(one, links, seen) for one in status.by_hand],
        services=services,
        topics=[
            one.seen(links.values(), report.topics if report is not None else {})
            for one in status.topics
        ],
        ready=sum(_is_ready(one) for one in replicas),
    )
    silent = [one.name for one in services if not one.ready_replicas]
    hangs = proxy_alive and fresh is None
    answers = None if hangs or not services else proxy_alive and not silent
    return replace(seen, status=found, answers=answers, unanswered=() if hangs else silent)


def _heard(link: LinkReport, written_at: float, since: float) -> LinkReport:
    heard_at = -1.0 if link.heard_age_s is None else written_at - link.heard_age_s
    if link.state is LinkState.UP and heard_at < since:
        return replace(link, state=LinkState.SUSPECT, detail="it did not answer a probe in time")
    return link


def _answers(link: LinkReport, service: str) -> bool:
    return link.state is LinkState.UP and service in link.ready


def _is_ready(one: ReplicaStatus) -> bool:
    return one.known and one.phase == Phase.READY.value and one.link == LinkState.UP.value


def _now(one: ReplicaStatus, links: _Links, seen: Seen) -> ReplicaStatus:
    """Return a replica with what its link says now; without one, with what is left unknown."""
    link = links.get((one.slot, one.generation))
    if link is None:
        known = not seen.stale and (seen.links_known or one.phase in _COMING)
        return replace(
            one, link="", rtt_s=None, silent_for_s=0.0, in_flight=0, known=known, lease_left_s=None
        )
    found = replace(
        one,
        link=link.state.value,
        rtt_s=link.rtt_s,
        silent_for_s=link.silent_for_s,
        won=link.won,
        in_flight=link.in_flight,
        restarts=link.restarts,
        strangers=link.strangers,
        detail=one.detail or (link.detail if one.phase == Phase.READY.value else ""),
        lease_left_s=link.lease_left_s,
        version=link.version,
    )
    names = {service.name for service in seen.status.services}
    if found.phase in _COMING and link.state is LinkState.UP and names and names <= link.ready:
        return replace(found, phase=Phase.READY.value, detail="")  # sooner than the manager saw it
    if not seen.stale:
        return found
    if link.state is not LinkState.UP or not link.ready:
        return replace(found, known=False, detail=link.detail)
    phase = Phase.DRAINING if link.draining else Phase.READY
    return replace(found, phase=phase.value, detail=link.detail)
