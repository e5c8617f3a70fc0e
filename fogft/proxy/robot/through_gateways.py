"""Replicas as they are seen through gateways, put as if they were linked directly. Pure.

So that the manager judges them as it judges all others: a gateway that is silent is a link
that is silent. Seen through several gateways, the best sight of a replica counts.

Owns: those reports. Not here: the links (`client`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from fogft.link.port import GatewayView, LinkStatus
from fogft.model.replica import LinkState

_ORDER = (LinkState.UP, LinkState.SUSPECT, LinkState.CONNECTING)


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
