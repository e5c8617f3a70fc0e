"""Membership: which replicas exist and where, written by the manager, read by proxies. Pure.

A late write by an old manager never replaces one by its successor: see `Membership.epoch`.
"""

import hashlib
import json
from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import Any

from fogft.errors import StateError
from fogft.model.credentials import holder_of
from fogft.model.plain import stored, to_plain
from fogft.model.replica import Machine, MachinePhase, Member, Membership, ReplicaId
from fogft.model.spec import PoolSpec
from fogft.model.topology import trouble


def members_of(
    machines: Iterable[Machine],
    spec: PoolSpec,
    *,
    pool_uid: str,
    draining: Collection[ReplicaId] = (),
    ending: Collection[ReplicaId] = (),
    revoked: Collection[str] = (),
    by_hand: Iterable[ReplicaId] = (),
) -> tuple[Member, ...]:
    """Return the members to hold links to: this pool's, not ending, not revoked, and findable.

    Replicas started by hand, which no cloud lists, come last: the highest generation of each slot
    that no machine has.
    """
    members = tuple(
        Member(
            machine.id,
            "" if spec.dial_in else machine.endpoint or "",  # it dials in, or has a record
            machine.id in draining or machine.notice,
            version=machine.spec_hash,
        )
        for machine in sorted(machines, key=lambda m: m.id)
        if machine.id.pool_uid == pool_uid
        and (machine.endpoint is not None or spec.rendezvous or spec.dial_in)
        and machine.phase is not MachinePhase.FAILED
        and machine.id not in ending
        and machine.id.certificate_name not in revoked
    )
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


def successor(current: Membership | None, wanted: Membership) -> Membership | None:
    """Return `wanted`, or a later version of it, to write after `current`.

    None if nothing changes, or a newer manager wrote.
    """
    if current is None or current.pool_uid != wanted.pool_uid:
        return wanted
    if wanted.epoch < current.epoch:
        return None  # a manager that was replaced writes nothing
    wanted = replace(wanted, revoked=current.revoked | wanted.revoked)
    if wanted.epoch > current.epoch:
        return wanted
    same = replace(wanted, version=current.version) == current
    return None if same else replace(wanted, version=current.version + 1)


def to_dict(membership: Membership) -> dict[str, Any]:
    """Return the JSON form, with its checksum."""
    content = to_plain(membership)
    return {**content, "checksum": checksum(content)}


def from_dict(raw: Any) -> Membership:
    """Read a membership back. Raises StateError if it is not one, or damaged."""
    try:
        content = {key: value for key, value in raw.items() if key != "checksum"}
        if raw["checksum"] != checksum(content):
            raise ValueError("its checksum is wrong")
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise StateError(f"not a membership: {error}") from error
    return from_content(content)


def from_content(content: Any) -> Membership:
    """Return a membership from its JSON form without the checksum."""
    membership = stored(Membership, content, "not a membership")
    ids = [m.id for m in membership.members]
    if len(set(ids)) != len(ids):
        raise StateError("not a membership: a replica is listed twice")
    try:
        uids = {id.pool_uid for id in ids} | {holder_of(n).pool_uid for n in membership.revoked}
    except ValueError as error:
        raise StateError(f"not a membership: {error}") from error
    if not uids <= {membership.pool_uid}:
        raise StateError("not a membership: it names members of another pool")
    if wrong := trouble(membership.topology):
        raise StateError(f"not a membership: {wrong}")
    return membership


def checksum(content: Any) -> str:
    """Return the checksum of stored JSON data, such as a membership's."""
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]
