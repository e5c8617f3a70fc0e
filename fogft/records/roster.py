"""What records say, put together: whom a proxy shall talk to, and where. Pure.

The manager's admission says which generation of which slot is in. A replica's own record
says where it is: it counts only while its generation is the one admitted.

Owns: the contents of records, and the membership that follows from them.
Not here: who may write them (`records`) and which one stands (`record_set`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

from fogft.errors import StateError
from fogft.model.credentials import Holder, holder_of
from fogft.model.membership import from_content
from fogft.model.names import gateway_slot, is_endpoint
from fogft.model.plain import Moment, from_plain, to_plain, within
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.records.record import COUNT_LIMIT, Record, RecordError, RecordKind

SERVICES_LIMIT = 256
NAME_LIMIT = 256
LEASE_LIMIT_S = 366 * 86_400.0


@dataclass(frozen=True)
class SlotState:
    """What a replica says of itself.

    Attributes:
        endpoint: ``host:port`` where it can be reached, as it was told; empty if it was not.
        observed_endpoint: The same as a rendezvous saw it: only a guess.
        dials_out: It cannot be reached: it dials robots and gateways itself.
        services: Names of the services that it can answer now.
        draining: It asked to be left alone.
        in_flight: Requests that it holds.
    """

    endpoint: str = ""
    observed_endpoint: str = ""
    dials_out: bool = False
    services: tuple[str, ...] = ()
    draining: bool = False
    in_flight: int = 0

    def to_content(self) -> dict[str, Any]:
        """Return it as a record's content."""
        return {
            "endpoint": self.endpoint,
            "observed_endpoint": self.observed_endpoint,
            "dials_out": self.dials_out,
            "services": list(self.services),
            "draining": self.draining,
            "in_flight": self.in_flight,
        }


@dataclass(frozen=True)
class ServingLease:
    """For how long replicas go on serving without hearing of the manager again.

    Attributes:
        at: When it was signed, in seconds since the epoch by the manager's clock.
        lasts_s: From then on; no longer than the pool itself may run (`max_hours`).
    """

    at: Moment
    lasts_s: Annotated[float, within(0, LEASE_LIMIT_S)]


@dataclass(frozen=True)
class DialIn:
    """Where replicas that cannot be reached may dial a robot or a gateway; empty for nowhere."""

    endpoint: str = ""
    extra: Mapping[str, Any] = field(default_factory=dict)

    def to_content(self) -> dict[str, Any]:
        """Return it as a record's content."""
        return {**self.extra, "dial_in": self.endpoint}


def slot_state(record: Record) -> SlotState:
    """Read a replica's record.

    Raises:
        RecordError: Its content is none.
    """
    raw = record.content
    services = raw.get("services")
    if not isinstance(services, list) or len(services) > SERVICES_LIMIT:
        raise RecordError("malformed", "services that are no list")
    return SlotState(
        endpoint=_endpoint(raw.get("endpoint")),
        observed_endpoint=_endpoint(raw.get("observed_endpoint")),
        dials_out=_truth(raw.get("dials_out")),
        services=tuple(_name(name) for name in services),
        draining=_truth(raw.get("draining")),
        in_flight=_count(raw.get("in_flight")),
    )


def dial_in(record: Record) -> str:
    """Return where a robot or a gateway lets replicas dial in; empty for nowhere.

    Raises:
        RecordError: Its content is none.
    """
    return _endpoint(record.content.get("dial_in", ""))


def admission_content(membership: Membership) -> dict[str, Any]:
    """Return a membership as the content of the manager's admission record."""
    whole = to_plain(membership)
    return {key: whole[key] for key in ("pool", "members", "topology")}


def admission(record: Record) -> Membership:
    """Read the manager's admission record: epoch and version are its generation and sequence.

    Raises:
        RecordError: Its content is none.
    """
    try:
        order = {"epoch": record.generation, "version": record.sequence}
        return from_content({**record.content, **order, "pool_uid": record.pool_uid, "revoked": []})
    except StateError as error:
        raise RecordError("malformed", error.message) from error


def revoked_names(record: Record) -> frozenset[str]:
    """Return the common names of certificates that a revocation record takes back.

    Raises:
        RecordError: Its content is none.
    """
    listed = record.content.get("names")
    if not isinstance(listed, list):
        raise RecordError("malformed", "names that are no list")
    try:
        holders = [holder_of(name) for name in listed]
    except (ValueError, TypeError, AttributeError):
        raise RecordError("malformed", "names that are none") from None
    if any(holder.pool_uid != record.pool_uid for holder in holders):
        raise RecordError("malformed", "names of another pool")
    return frozenset(holder.common_name for holder in holders)


def lease(record: Record) -> ServingLease:
    """Read the manager's lease.

    Raises:
        RecordError: Its content is none.
    """
    try:
        return from_plain(ServingLease, record.content)
    except ValueError as error:
        raise RecordError("malformed", str(error)) from error


def check_content(record: Record) -> None:
    """See that a record's content can be used.

    Raises:
        RecordError: It cannot.
    """
    if record.kind is RecordKind.ADMISSION:
        admission(record)
    elif record.kind is RecordKind.REVOCATION:
        revoked_names(record)
    elif record.kind is RecordKind.LEASE:
        lease(record)
    elif record.kind is RecordKind.SLOT:
        slot_state(record)
    elif record.kind in (RecordKind.ROBOT, RecordKind.GATEWAY):
        dial_in(record)


def located(membership: Membership, slots: Iterable[Record]) -> Membership:
    """Return a membership with what admitted replicas say of themselves.

    A replica that was told its address knows best, then the manager's word counts, then what
    a rendezvous saw. One that dials out has no endpoint: it is waited for.
    """
    said = {(int(r.subject), r.generation): slot_state(r) for r in slots}
    return replace(
        membership,
        members=tuple(
            _located(m, said.get((m.id.slot, m.id.generation))) for m in membership.members
        ),
    )


def gateways_of(membership: Membership, holder: Holder) -> tuple[Member, ...] | None:
    """Return the gateways that somebody talks to, as members; None for the replicas.

    While a gateway's certificate is being replaced there are two of it, one of which answers.
    """
    gateways = membership.topology.neighbours(holder)
    if not gateways:
        return None
    uid = membership.pool_uid
    return tuple(
        Member(
            ReplicaId(uid, gateway_slot(gateway.name), generation),
            gateway.endpoint,
            gateway=gateway.name,
        )
        for gateway in gateways
        for generation in gateway.generations
    )


def _located(member: Member, state: SlotState | None) -> Member:
    if state is None:
        return member
    endpoint = state.endpoint or member.endpoint or state.observed_endpoint
    draining = member.draining or state.draining
    return replace(member, endpoint="" if state.dials_out else endpoint, draining=draining)


def _endpoint(value: Any) -> str:
    if not isinstance(value, str) or len(value) > NAME_LIMIT or not value.isprintable():
        raise RecordError("malformed", "an endpoint that is none")
    if value and not is_endpoint(value):
        raise RecordError("malformed", "an endpoint that is not host:port")
    return value


def _truth(value: Any) -> bool:
    if not isinstance(value, bool):
        raise RecordError("malformed", "neither true nor false")
    return value


def _name(value: Any) -> str:
    if not isinstance(value, str) or not value.isprintable() or not 0 < len(value) <= NAME_LIMIT:
        raise RecordError("malformed", "a name that is none")
    return value


def _count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < COUNT_LIMIT:
        raise RecordError("malformed", "a count that is none")
    return value
