"""Combine records into a membership: the replicas and their endpoints. Pure.

A replica's own record counts only while its generation is the one that the manager admitted.
Content that does not fit the kind of its record raises `RecordError`.

Not here: who may write a record (`record`) and which one is the latest (`record_set`).
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Annotated, Any

from fogft.errors import StateError
from fogft.model.credentials import Holder, holder_of
from fogft.model.membership import from_content
from fogft.model.names import EndpointOrEmpty, gateway_slot
from fogft.model.plain import Line, Moment, to_plain, within
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.records.record import Record, RecordError, RecordKind, read

LEASE_LIMIT_S = 366 * 86_400.0


@dataclass(frozen=True)
class SlotState:
    """A replica's own record."""

    endpoint: EndpointOrEmpty = ""  # where it can be reached, as configured; empty if not set
    observed_endpoint: EndpointOrEmpty = ""  # the same, as a rendezvous saw it: only a guess
    dials_out: bool = False  # it cannot be reached: it dials robots and gateways itself
    services: tuple[Line, ...] = ()
    draining: bool = False


@dataclass(frozen=True)
class ServingLease:
    """How long replicas keep serving without hearing from the manager again."""

    at: Moment  # when it was signed, by the manager's clock
    lasts_s: Annotated[float, within(0, LEASE_LIMIT_S)]  # no longer than `max_hours` allows


@dataclass(frozen=True)
class DialIn:
    """Where replicas that cannot be reached may dial a robot or a gateway; empty for nowhere."""

    dial_in: EndpointOrEmpty = ""


def slot_state(record: Record) -> SlotState:
    """Read a replica's record."""
    return read(SlotState, record.content)


def dial_in(record: Record) -> str:
    """Return where a robot or a gateway lets replicas dial in; empty for nowhere."""
    return read(DialIn, record.content).dial_in


def admission_content(membership: Membership) -> dict[str, Any]:
    """Return a membership as the content of the manager's admission record."""
    whole = to_plain(membership)
    return {key: whole[key] for key in ("pool", "members", "topology")}


def admission(record: Record) -> Membership:
    """Read the manager's admission record: epoch and version are its generation and sequence."""
    try:
        order = {"epoch": record.generation, "version": record.sequence}
        return from_content({**record.content, **order, "pool_uid": record.pool_uid, "revoked": []})
    except StateError as error:
        raise RecordError("malformed", error.message) from error


def revoked_names(record: Record) -> frozenset[str]:
    """Return the common names that a revocation record revokes."""
    names = read(frozenset[Annotated[str, holder_of]], record.content.get("names"))
    if any(holder_of(name).pool_uid != record.pool_uid for name in names):
        raise RecordError("malformed", "names of another pool")
    return names


def lease(record: Record) -> ServingLease:
    """Read the manager's lease."""
    return read(ServingLease, record.content)


READERS: dict[RecordKind, Callable[[Record], object]] = {
    RecordKind.ADMISSION: admission,
    RecordKind.REVOCATION: revoked_names,
    RecordKind.LEASE: lease,
    RecordKind.SLOT: slot_state,
    RecordKind.ROBOT: dial_in,
    RecordKind.GATEWAY: dial_in,
}
"""Functions that parse and validate the content of each kind of record."""


def located(membership: Membership, slots: Iterable[Record]) -> Membership:
    """Return a membership completed with admitted replicas' own records.

    The address configured on a replica comes first, then the manager's, then the one that a
    rendezvous saw. A replica that dials out has no endpoint: its connection is awaited.
    """
    said = {(int(r.subject), r.generation): slot_state(r) for r in slots}
    members = (_located(m, said.get((m.id.slot, m.id.generation))) for m in membership.members)
    return replace(membership, members=tuple(members))


def gateways_of(membership: Membership, holder: Holder) -> tuple[Member, ...] | None:
    """Return the gateways of a robot or gateway, as members; None if it uses the replicas directly.

    While a gateway's certificate is being replaced, it has two members, one of which answers.
    """
    gateways = membership.topology.neighbours(holder)
    if not gateways:
        return None
    uid = membership.pool_uid
    return tuple(
        Member(ReplicaId(uid, gateway_slot(one.name), generation), one.endpoint, gateway=one.name)
        for one in gateways
        for generation in one.generations
    )


def _located(member: Member, state: SlotState | None) -> Member:
    if state is None:
        return member
    endpoint = state.endpoint or member.endpoint or state.observed_endpoint
    draining = member.draining or state.draining
    return replace(member, endpoint="" if state.dials_out else endpoint, draining=draining)
