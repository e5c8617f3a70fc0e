"""Whether the types of services are the same here and on each replica.

A replica whose type differs is not asked: its bytes would be read as another message.

Owns: what each replica told of its types, compared with ours, once.
Not here: the comparison itself (`fogft.model.type_definition`), whom a request goes to (`client`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping

from fogft.link.port import Link
from fogft.model.replica import ReplicaId
from fogft.model.spec import ServiceSpec
from fogft.model.type_definition import Definition, difference

log = logging.getLogger(__name__)

Define = Callable[[str], Definition]


class TypeCheck:
    """Compares what replicas tell of their types with what they are here.

    Args:
        define: Returns a type's definition here; None where types are not known here.
    """

    def __init__(self, define: Define | None) -> None:
        self._define = define
        self._ours: dict[str, Definition] = {}
        self._found: dict[tuple[ReplicaId, str], tuple[Definition, str]] = {}

    def differences(self, link: Link, services: Iterable[ServiceSpec]) -> Mapping[str, str]:
        """Return which services a replica cannot answer for us, and why, in words.

        An older replica tells nothing of its types: then nothing is said against it.
        """
        answer = link.status().probe_answer
        if self._define is None or answer is None or not answer.types:
            return {}
        found = {}
        for service in services:
            theirs = answer.types.get(service.type)
            why = "" if theirs is None else self._compare(link.peer.id, service.type, theirs)
            if why:
                found[service.name] = why
        return found

    def _compare(self, id: ReplicaId, type_name: str, theirs: Definition) -> str:
        known = self._found.get((id, type_name))
        if known is not None and known[0] is theirs:
            return known[1]
        ours = self._ours.get(type_name)
        if ours is None and self._define is not None:
            ours = self._define(type_name)
            if not ours.known:
                return ""  # until it is: where no types are loaded, a client tells its hash
            self._ours[type_name] = ours
        why = difference(type_name, ours or Definition(), theirs)
        if why and (known is None or known[1] != why):
            log.error("type_differs replica=%s reason=%r", id.short, why)
        self._found[(id, type_name)] = (theirs, why)
        return why

    def forget(self, id: ReplicaId) -> None:
        """Drop what is kept of a replica that is gone."""
        for key in [key for key in self._found if key[0] == id]:
            del self._found[key]
