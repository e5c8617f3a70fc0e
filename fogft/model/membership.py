"""Who is where: the record that the manager writes and proxies follow. Pure.

A membership is ordered by (epoch, version): the epoch is the writing manager's lease, so
what an old manager wrote late never replaces what its successor wrote. Its JSON form
carries a checksum; a damaged one is an error and changes nothing.

Owns: building a membership from machines, its order and its JSON form.
Not here: the file (`fogft.pool.folder.store`) and what a proxy does with it (`fogft.proxy`).
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Iterable, Mapping
from enum import Enum
from typing import Any

from fogft.errors import StateError
from fogft.model.credentials import holder_of
from fogft.model.names import POOL_UID_PATTERN, is_endpoint
from fogft.model.replica import Machine, MachinePhase, Member, Membership, ReplicaId
from fogft.model.spec import PoolSpec
from fogft.model.topology import Topology

_PARTS = ("pool", "pool_uid", "epoch", "version", "members", "revoked", "topology")
VERSION = re.compile(r"[\w.-]{0,64}", re.ASCII)


class Found(Enum):
    """How a proxy finds a replica."""

    BY_CLOUD = "cloud"  # at the endpoint that the cloud tells
    BY_RECORD = "record"  # there, or where its own record says that it is
    BY_DOOR = "door"  # it dials in

    @classmethod
    def of(cls, spec: PoolSpec) -> Found:
        """Return how the replicas of a pool are found."""
        if spec.dial_in:
            return cls.BY_DOOR
        return cls.BY_RECORD if spec.rendezvous else cls.BY_CLOUD


def members_of(
    machines: Iterable[Machine],
    *,
    pool_uid: str,
    draining: Collection[ReplicaId] = (),
    ending: Collection[ReplicaId] = (),
    revoked: Collection[str] = (),
    found: Found = Found.BY_CLOUD,
) -> tuple[Member, ...]:
    """Return whom a proxy should hold a link to.

    Those are ours, not ending, not revoked, and can be found.
    """
    return tuple(
        Member(
            machine.id,
            "" if found is Found.BY_DOOR else machine.endpoint or "",
            machine.id in draining or machine.notice,
            version=machine.spec_hash,
        )
        for machine in sorted(machines, key=lambda m: m.id)
        if machine.id.pool_uid == pool_uid
        and (machine.endpoint is not None or found is not Found.BY_CLOUD)
        and machine.phase is not MachinePhase.FAILED
        and machine.id not in ending
        and machine.id.certificate_name not in revoked
    )


def with_by_hand(members: tuple[Member, ...], by_hand: Iterable[ReplicaId]) -> tuple[Member, ...]:
    """Return members with those that people start themselves, whom no cloud lists.

    Where they are is theirs to say: by a record, or by dialling in. Of several generations
    of a slot the highest is meant; a slot that a machine has is the machine's.
    """
    taken = {member.id.slot for member in members}
    latest = {id.slot: id for id in sorted(by_hand) if id.slot not in taken}
    return (*members, *(Member(latest[slot], "") for slot in sorted(latest)))


def is_newer(candidate: Membership, current: Membership | None) -> bool:
    """Whether a membership replaces another of the same pool."""
    if current is None:
        return True
    if candidate.pool_uid != current.pool_uid:
        return False
    return (candidate.epoch, candidate.version) > (current.epoch, current.version)


def successor(
    current: Membership | None,
    *,
    pool: str,
    pool_uid: str,
    epoch: int,
    members: tuple[Member, ...],
    revoked: Collection[str] = (),
    topology: Topology | None = None,
) -> Membership | None:
    """Return the next membership to write, or None when nothing would change.

    What was revoked stays revoked, whether or not it is named again.
    """
    topology = topology or Topology()
    if current is None or current.pool_uid != pool_uid:
        return Membership(pool, pool_uid, epoch, 1, members, frozenset(revoked), topology)
    if epoch < current.epoch:
        return None  # a manager that was replaced writes nothing
    all_revoked = current.revoked | frozenset(revoked)
    now = (current.members, current.revoked, current.topology)
    if epoch == current.epoch and (members, all_revoked, topology) == now:
        return None
    version = current.version + 1 if epoch == current.epoch else 1
    return Membership(pool, pool_uid, epoch, version, members, all_revoked, topology)


def to_dict(membership: Membership) -> dict[str, Any]:
    """Return the JSON form, with its checksum."""
    content = {
        "pool": membership.pool,
        "pool_uid": membership.pool_uid,
        "epoch": membership.epoch,
        "version": membership.version,
        "members": [
            {
                "slot": m.id.slot,
                "generation": m.id.generation,
                "endpoint": m.endpoint,
                "draining": m.draining,
                "version": m.version,
            }
            for m in membership.members
        ],
        "revoked": sorted(membership.revoked),
        "topology": membership.topology.to_plain(),
    }
    return {**content, "checksum": checksum(content)}


def from_dict(raw: Any) -> Membership:
    """Read a membership back.

    Raises:
        StateError: It is none, or it is damaged.
    """
    try:
        content = {key: value for key, value in raw.items() if key != "checksum"}
        if raw["checksum"] != checksum(content):
            raise ValueError("its checksum is wrong")
        parts = {key: content[key] for key in _PARTS}
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise StateError(f"not a membership: {error}") from error
    return from_parts(**parts)


def from_parts(
    *,
    pool: Any,
    pool_uid: Any,
    epoch: Any,
    version: Any,
    members: Any,
    revoked: Any = (),
    topology: Any = None,
) -> Membership:
    """Return a membership from plain data.

    Raises:
        StateError: It is none.
    """
    try:
        if not POOL_UID_PATTERN.fullmatch(pool_uid):
            raise ValueError("its pool_uid is not one")
        membership = Membership(
            pool=_text(pool),
            pool_uid=pool_uid,
            epoch=_count(epoch),
            version=_count(version),
            members=tuple(_member(pool_uid, entry) for entry in members),
            revoked=frozenset(_revoked(pool_uid, name) for name in revoked),
            topology=Topology() if topology is None else Topology.from_plain(topology),
        )
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise StateError(f"not a membership: {error}") from error
    ids = [m.id for m in membership.members]
    if len(set(ids)) != len(ids):
        raise StateError("not a membership: a replica is listed twice")
    return membership


def _member(uid: str, entry: Mapping[str, Any]) -> Member:
    endpoint = _text(entry["endpoint"])
    if endpoint and not is_endpoint(endpoint):
        raise ValueError(f"`{endpoint:.80}` is not host:port")
    if not isinstance(entry["draining"], bool):
        raise TypeError("draining is not true or false")
    id = ReplicaId(uid, _count(entry["slot"]), _count(entry["generation"]))
    version = _text(entry["version"])
    if not VERSION.fullmatch(version):
        raise ValueError(f"`{version:.40}` is not a version")
    return Member(id, endpoint, entry["draining"], version=version)


def _revoked(uid: str, entry: Any) -> str:
    holder = holder_of(_text(entry))
    if holder.pool_uid != uid:
        raise ValueError("it revokes what is another pool's")
    return holder.common_name


def _count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ValueError(f"not a count: {value!r:.40}")
    return value


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"not a text: {value!r:.40}")
    return value


def checksum(content: Mapping[str, Any]) -> str:
    """Return what a membership's JSON form is checked by."""
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]
