"""What `proxy-status.json` says of each replica: linked directly, or seen through gateways. Pure.

Seen through a gateway a replica is put as if it were linked directly, so that the manager judges
it as it judges all others: a gateway that is silent is a link that is silent. Seen through
several gateways, the best sight of a replica counts.

Owns: those reports. Not here: the links (`client`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

from fogft.link.port import GatewayView, Link, LinkStatus
from fogft.model.replica import LinkState
from fogft.proxy.robot.dispatcher import Dispatcher
from fogft.proxy.robot.sending import key_of

_ORDER = (LinkState.UP, LinkState.SUSPECT, LinkState.CONNECTING)


def link_report(
    link: Link, dispatchers: Collection[Dispatcher], differ: Mapping[str, str], *, draining: bool
) -> dict[str, Any]:
    """Return what is reported of a link.

    Args:
        link: It.
        dispatchers: Of all services.
        differ: Services that its replica cannot answer for us, and why.
        draining: Its replica is to be left alone.
    """
    status, id = link.status(), link.peer.id
    answer = status.probe_answer
    ours = next(iter(differ.values()), "") if link.usable else ""
    ended = [dispatcher.outcomes.by(id) for dispatcher in dispatchers]
    return {
        "slot": id.slot,
        "generation": id.generation,
        "state": status.state.value,
        "ready": sorted(link.ready - differ.keys()),
        "differs": bool(ours),
        "differing": sorted(differ) if ours else [],
        "offered": dict(answer.offered) if answer and link.usable else {},
        "draining": draining,
        "at_risk": bool(answer and answer.at_risk),
        "disagrees": any(dispatcher.disagrees(key_of(link)) for dispatcher in dispatchers),
        "misread": any(dispatcher.misreads(key_of(link)) for dispatcher in dispatchers),
        "heard_age_s": status.heard_age_s,
        "silent_for_s": status.silent_for_s,
        "rtt_s": status.rtt_s,
        "in_flight": status.in_flight,
        "reopened": status.reopened,
        "won": sum(dispatcher.outcomes.won_by(id) for dispatcher in dispatchers),
        "restarts": answer.restarts if answer else 0,
        "strangers": answer.strangers if answer else 0,
        "answered": sum(well for well, _ in ended),
        "failed": sum(ill for _, ill in ended),
        "work": dict(answer.work) if answer else {},
        "hanging": sorted(answer.hanging) if answer else [],
        "version": answer.version if answer else "",
        "lease_age_s": answer.lease_age_s if answer else None,
        "lease_left_s": answer.lease_left_s if answer else None,
        **({"uplinks": list(status.uplinks)} if status.uplinks else {}),
        "detail": status.detail or ours or (answer.detail if answer else ""),
    }


def seen_through(status: LinkStatus, gateway: str) -> list[dict[str, Any]]:
    """Return the replicas that a gateway told of, as reports of links.

    Args:
        status: Of the link to the gateway.
        gateway: Its name.
    """
    answer = status.probe_answer
    return [_report(status, gateway, one) for one in (answer.behind if answer else ())]


def _report(status: LinkStatus, gateway: str, one: GatewayView) -> dict[str, Any]:
    up = status.state is LinkState.UP
    state = one.state if up or one.state is not LinkState.UP else LinkState.SUSPECT
    rtt_s = None if one.rtt_s is None or status.rtt_s is None else one.rtt_s + status.rtt_s
    heard = status.heard_age_s
    return {
        "slot": one.slot,
        "generation": one.generation,
        "state": state.value,
        "ready": sorted(one.ready) if up else [],
        "draining": one.draining,
        "at_risk": one.at_risk,
        "disagrees": False,
        "differs": False,
        "offered": {},
        "heard_age_s": None
        if one.state is LinkState.CONNECTING or heard is None
        else heard + one.silent_for_s,
        "silent_for_s": max(one.silent_for_s, status.silent_for_s),
        "rtt_s": rtt_s,
        "in_flight": 0,
        "reopened": 0,
        "won": 0,
        "restarts": one.restarts,
        "version": one.version,
        "lease_age_s": one.lease_age_s,
        "lease_left_s": one.lease_left_s,
        "work": {},
        "detail": one.detail if up else f"gateway `{gateway}`: {status.detail}",
        "through": f"{gateway}/{one.through}" if one.through else gateway,
    }


def best_of(reports: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the best report of each replica, by slot and generation."""

    def rank(report: dict[str, Any]) -> tuple[int, bool, float]:
        state = _ORDER.index(LinkState(report["state"]))
        return (state, not report["ready"], report["silent_for_s"])

    found: dict[tuple[int, int], dict[str, Any]] = {}
    for report in reports:
        key = (report["slot"], report["generation"])
        if key not in found or rank(report) < rank(found[key]):
            found[key] = report
    return [found[key] for key in sorted(found)]
