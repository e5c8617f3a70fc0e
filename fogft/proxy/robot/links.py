"""The links of a client proxy, one per member, and its report of each replica.

A replica seen through a gateway is reported as if it were linked directly, so that the manager
judges it like any other; of several reports the best counts. A replica whose types differ from ours
is not asked: its bytes would be misread as another message.

Under the client proxy's lock. Not here: which links a service may use (`proxied_service`).
"""

import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import asdict
from typing import Any

from fogft.link.port import Dialer, GatewayView, Link, LinkEvents, LinkStatus, Peer
from fogft.metrics.outcomes import OfReplica
from fogft.model.replica import LinkState, Member, ReplicaId
from fogft.model.topic import PREFIX
from fogft.model.type_definition import Definition, difference
from fogft.proxy.robot.dispatcher import Dispatcher
from fogft.proxy.robot.sending import key_of

log = logging.getLogger(__name__)

_ORDER = (LinkState.UP, LinkState.SUSPECT, LinkState.CONNECTING)


def link_report(
    link: Link,
    dispatchers: Collection[Dispatcher],
    differ: Mapping[str, str],
    *,
    draining: bool,
    misread: bool,
) -> dict[str, Any]:
    """Return the report of a link; `differ`: services and topics not usable there, with reasons."""
    status, id = link.status(), link.peer.id
    answer = status.probe_answer
    told = differ if link.usable else {}
    ours = next((why for name, why in told.items() if not name.startswith(PREFIX)), "")
    key = key_of(link)
    misread = misread or any(one.misreads(key) for one in dispatchers)
    ended = [one.outcomes.of.get(key, OfReplica()) for one in dispatchers]
    down = [f"uplink `{u['interface']}`: {u['detail']}" for u in status.uplinks if u["detail"]]
    down += told.values()
    return {
        "slot": id.slot,
        "generation": id.generation,
        "state": status.state.value,
        "ready": sorted(link.ready - differ.keys()),
        "differs": bool(ours),
        "differing": sorted(told),
        "offered": dict(answer.offered) if answer and link.usable else {},
        "leaving": link.leaving,
        "draining": draining,
        "at_risk": bool(answer and answer.at_risk),
        "disagrees": status.ignores or misread or any(one.disagrees(key) for one in dispatchers),
        "ignores": status.ignores,
        "misread": misread,
        "heard_age_s": status.heard_age_s,
        "silent_for_s": status.silent_for_s,
        "rtt_s": status.rtt_s,
        "in_flight": status.in_flight,
        "reopened": status.reopened,
        "won": sum(one.won for one in ended),
        "restarts": answer.restarts if answer else 0,
        "strangers": answer.strangers if answer else 0,
        "answered": sum(one.well for one in ended),
        "failed": sum(one.ill for one in ended),
        "work": dict(answer.work) if answer else {},
        "hanging": sorted(answer.hanging) if answer else [],
        "version": answer.version if answer else "",
        "lease_age_s": answer.lease_age_s if answer else None,
        "lease_left_s": answer.lease_left_s if answer else None,
        **({"uplinks": list(status.uplinks)} if status.uplinks else {}),
        "detail": status.detail or ours or (answer and answer.detail) or "; ".join(down),
    }


def seen_through(status: LinkStatus, gateway: str) -> list[dict[str, Any]]:
    """Return link reports of the replicas behind a gateway."""
    answer = status.probe_answer
    return [_report(status, gateway, one) for one in (answer.behind if answer else ())]


def _report(status: LinkStatus, gateway: str, one: GatewayView) -> dict[str, Any]:
    up = status.state is LinkState.UP
    state = one.state if up or one.state is not LinkState.UP else LinkState.SUSPECT
    rtt_s = None if one.rtt_s is None or status.rtt_s is None else one.rtt_s + status.rtt_s
    heard = status.heard_age_s
    return {
        **asdict(one),
        "leaving": one.draining,
        "state": state.value,
        "ready": sorted(one.ready) if up else [],
        "heard_age_s": None
        if one.state is LinkState.CONNECTING or heard is None
        else heard + one.silent_for_s,
        "silent_for_s": max(one.silent_for_s, status.silent_for_s),
        "rtt_s": rtt_s,
        "in_flight": 0,
        "reopened": 0,
        "won": 0,
        "work": {},
        "detail": one.detail if up else f"gateway `{gateway}`: {status.detail}",
        "through": f"{gateway}/{one.through}" if one.through else gateway,
    }


def best_of(reports: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the best report of each replica, by slot and generation."""

    def rank(report: dict[str, Any]) -> tuple[int, bool, float]:
        state = _ORDER.index(LinkState(report["state"]))
        return (state, not report["ready"], report["silent_for_s"])

    worst_first = sorted(reports, key=rank, reverse=True)
    best = {(report["slot"], report["generation"]): report for report in worst_first}
    return [best[key] for key in sorted(best)]


Define = Callable[[str], Definition]


class TypeCheck:
    """Compares replicas' type definitions with those on this machine, if these are known."""

    def __init__(self, define: Define) -> None:
        self._define = define
        self._ours: dict[str, Definition] = {}
        self._found: dict[tuple[ReplicaId, str], tuple[Definition, str]] = {}

    def differences(self, link: Link, types: Mapping[str, str]) -> Mapping[str, str]:
        """Return the services and topics of a replica whose types are not as here, with reasons."""
        answer = link.status().probe_answer
        if answer is None or not (answer.types or answer.offered):
            return {}
        found = {}
        for name, type_name in types.items():
            theirs = answer.types.get(type_name)
            offered = answer.offered.get(name, type_name)
            if offered != type_name and name not in answer.ready:
                found[name] = f"`run` offers {name} as {offered}, not as {type_name}"
            elif theirs and (why := self._compare(link.peer.id, type_name, theirs)):
                found[name] = why
        return found

    def _compare(self, id: ReplicaId, type_name: str, theirs: Definition) -> str:
        known = self._found.get((id, type_name))
        if known is not None and known[0] is theirs:
            return known[1]
        ours = self._ours.get(type_name)
        if ours is None:
            ours = self._define(type_name)
            if not ours.known:
                return ""  # not known yet: without loaded types, a client reveals the hash later
            self._ours[type_name] = ours
        why = difference(type_name, ours, theirs)
        if why and (known is None or known[1] != why):
            log.error("type_differs replica=%s reason=%r", id.short, why)
        self._found[(id, type_name)] = (theirs, why)
        return why

    def forget(self, id: ReplicaId) -> None:
        """Forget a replica that is gone."""
        for key in [key for key in self._found if key[0] == id]:
            del self._found[key]


class Links:
    """The links of a client proxy; `keys` returns the keys of all services and topics at a slot."""

    def __init__(
        self, dialer: Dialer, events: LinkEvents, keys: Callable[[int], Mapping[str, str]]
    ) -> None:
        self._dialer = dialer
        self._events = events
        self._keys = keys
        self._links: dict[ReplicaId, Link] = {}
        self.members: dict[ReplicaId, Member] = {}

    def __iter__(self) -> Iterator[Link]:
        """Iterate over all links; safe while another thread changes them."""
        return iter(list(self._links.values()))

    def reach(self, member: Member) -> None:
        """Ensure a link to a member; redial it if it has moved."""
        old = self.members.get(member.id)
        self.members[member.id] = member
        if old is None or old.endpoint != member.endpoint:
            self._dial(member)

    def redial(self) -> None:
        """Redial all replicas; requests in flight are sent again."""
        for id in list(self._links):
            self._dial(self.members[id])

    def _dial(self, member: Member) -> None:
        id, old = member.id, self._links.get(member.id)
        peer = Peer(id, member.endpoint, member.certificate_name)
        self._links[id] = self._dialer.dial(peer, self._keys(id.slot), self._events)
        who = f"gateway={member.gateway}" if member.gateway else f"replica={id.short}"
        log.info("link_dialled %s endpoint=%s", who, member.endpoint)
        if old is not None:
            old.close()

    def remove(self, id: ReplicaId) -> Link:
        """Remove a link; close it once no route uses it."""
        self.members.pop(id, None)
        log.info("link_dropped replica=%s", id.short)
        return self._links.pop(id)

    def draining(self, link: Link) -> bool:
        """Whether a replica is draining: it says that it is leaving, or the manager marked it."""
        return link.leaving or self.members[link.peer.id].draining

    @property
    def silent_together(self) -> bool:
        """Whether all links that ever answered (at least two) fell silent together."""
        states = [link.status() for link in self]
        heard = [status for status in states if status.heard_age_s is not None]
        return len(heard) > 1 and all(status.state is not LinkState.UP for status in heard)

    @property
    def ready(self) -> frozenset[str]:
        """The services that at least one link reports ready."""
        return frozenset(name for link in self for name in link.ready)

    def hanging(self) -> dict[ReplicaId, frozenset[str]]:
        """Return, by replica, the services that it reports as hanging."""
        answers = {link.peer.id: link.status().probe_answer for link in self}
        return {id: answer.hanging for id, answer in answers.items() if answer is not None}

    def told(self) -> dict[str, list[Definition]]:
        """Return each type's definitions as reported by replicas, one per replica."""
        told: dict[str, list[Definition]] = {}
        for link in self:
            answer = link.status().probe_answer
            for name, definition in (answer.types if answer is not None else {}).items():
                told.setdefault(name, []).append(definition)
        return told

    def types(self) -> dict[str, Definition]:
        """Return each type's definition that most replicas report."""
        return {name: max(all_of, key=all_of.count) for name, all_of in self.told().items()}
