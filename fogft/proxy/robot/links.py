"""The links of a client proxy: one to each member, a replica or a gateway.

Owns: which links exist. Not here: which of them a service uses (`client`), links themselves
(`fogft.link`), what is reported of one (`link_reports`). Under the client proxy's lock.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

from fogft.link.port import Dialer, Link, LinkEvents, Peer
from fogft.model.replica import LinkState, Member, ReplicaId
from fogft.model.type_definition import Definition
from fogft.proxy.robot.dispatcher import Dispatcher
from fogft.proxy.robot.link_reports import best_of, link_report, seen_through

log = logging.getLogger(__name__)

Keys = Callable[[int], Mapping[str, str]]


class Links:
    """Who is talked to.

    Args:
        dialer: Makes links.
        events: Hears what links tell.
        keys: Returns the keys of all services and topics at a slot.
    """

    def __init__(self, dialer: Dialer, events: LinkEvents, keys: Keys) -> None:
        self._dialer = dialer
        self._events = events
        self._keys = keys
        self._links: dict[ReplicaId, Link] = {}
        self._members: dict[ReplicaId, Member] = {}

    def __iter__(self) -> Iterator[Link]:
        """Go over all of them; safe while another thread changes them."""
        return iter(list(self._links.values()))

    def missing(self, members: Collection[ReplicaId]) -> list[ReplicaId]:
        """Return whom there is a link to, and who is no member any more."""
        return [id for id in self._links if id not in members]

    def reach(self, member: Member) -> None:
        """Have a link to a member; dial it anew where it has moved."""
        old = self._members.get(member.id)
        self._members[member.id] = member
        if old is None or old.endpoint != member.endpoint:
            self._dial(member)

    def redial(self) -> None:
        """Dial everybody anew; what is in flight is sent again."""
        for id in list(self._links):
            self._dial(self._members[id])

    def _dial(self, member: Member) -> None:
        id, old = member.id, self._links.get(member.id)
        peer = Peer(id, member.endpoint, member.certificate_name)
        self._links[id] = self._dialer.dial(peer, self._keys(id.slot), self._events)
        who = f"gateway={member.gateway}" if member.gateway else f"replica={id.short}"
        log.info("link_dialled %s endpoint=%s", who, member.endpoint)
        if old is not None:
            old.close()

    def remove(self, id: ReplicaId) -> Link:
        """Take a link out; to be closed once it is out of every route."""
        self._members.pop(id, None)
        log.info("link_dropped replica=%s", id.short)
        return self._links.pop(id)

    # -- what they tell -------------------------------------------------------------------

    def draining(self, link: Link) -> bool:
        """Whether a replica is to be left alone: it says so, or the manager does."""
        member = self._members.get(link.peer.id)
        return link.draining or (member is not None and member.draining)

    def versions(self) -> dict[ReplicaId, str]:
        """Return what each member runs."""
        return {id: member.version for id, member in self._members.items()}

    @property
    def silent_together(self) -> bool:
        """Whether all that ever answered (two at least) have fallen silent together."""
        states = [link.status() for link in self]
        heard = [status for status in states if status.heard_age_s is not None]
        return len(heard) > 1 and all(status.state is not LinkState.UP for status in heard)

    @property
    def ready(self) -> frozenset[str]:
        """Services that at least one link calls ready."""
        return frozenset(name for link in self for name in link.ready)

    def hanging(self) -> dict[ReplicaId, frozenset[str]]:
        """Return the services that a replica says answer nothing of what they have."""
        answers = {link.peer.id: link.status().probe_answer for link in self}
        return {id: answer.hanging for id, answer in answers.items() if answer is not None}

    def types(self) -> dict[str, Definition]:
        """Return the definitions of types as most replicas told them."""
        told: dict[str, list[Definition]] = {}
        for link in self:
            answer = link.status().probe_answer
            for name, definition in (answer.types if answer is not None else {}).items():
                told.setdefault(name, []).append(definition)
        return {name: max(all_of, key=all_of.count) for name, all_of in told.items()}

    def reports(
        self,
        dispatchers: Collection[Dispatcher],
        differences: Callable[[Link], Mapping[str, str]],
    ) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Return the links to replicas, those behind gateways included, and those to gateways."""
        replicas, gateways, behind = [], [], []
        for id, link in sorted(self._links.items()):
            member = self._members.get(id)
            draining = self.draining(link)
            report = link_report(link, dispatchers, differences(link), draining=draining)
            if member is None or not member.gateway:
                replicas.append(report)
                continue
            gateways.append({"name": member.gateway, "endpoint": member.endpoint, **report})
            behind += seen_through(link.status(), member.gateway)
        return [*replicas, *best_of(behind)], gateways
