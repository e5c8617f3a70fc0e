"""Records for tests of pure code: a signature is the writer's name and a hash."""

from __future__ import annotations

import hashlib

from hypothesis import strategies as st

from fogft.model.plain import to_plain
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.records.record import (
    Record,
    RecordError,
    RecordKind,
    Sign,
    SignedRecord,
    Writer,
    expected_writer,
    sign_record,
)
from fogft.records.roster import SlotState, admission_content

UID = "0123456789abcdef"


def signer(role: str, common_name: str) -> Sign:
    """Return how this writer signs."""
    certificate = f"{role}|{common_name}|{hashlib.md5(common_name.encode()).hexdigest()}"

    def sign(message: bytes) -> tuple[bytes, bytes]:
        return certificate.encode(), hashlib.sha256(certificate.encode() + message).digest()

    return sign


def verify(certificate: bytes, signature: bytes, message: bytes) -> Writer:
    """Check a signature of `signer`."""
    if hashlib.sha256(certificate + message).digest() != signature:
        raise RecordError("forged", "a signature that is wrong")
    role, common_name, _ = certificate.decode().split("|")
    return Writer(role, common_name)


def signed(record: Record) -> SignedRecord:
    """Return a record signed by the one who may write it."""
    writer = expected_writer(record)
    return sign_record(record, signer(writer.role.value, writer.common_name))


def admission(epoch: int, version: int, *members: Member) -> SignedRecord:
    membership = Membership("p", UID, epoch, version, members)
    content = admission_content(membership)
    return signed(Record(UID, RecordKind.ADMISSION, "", epoch, version, content))


def slot(
    number: int, generation: int, sequence: int, state: SlotState | None = None
) -> SignedRecord:
    content = to_plain(state or SlotState())
    record = Record(UID, RecordKind.SLOT, str(number), generation, sequence, content)
    return signed(record)


def revocation(sequence: int, *revoked: str, epoch: int = 1) -> SignedRecord:
    content = {"names": list(revoked)}
    return signed(Record(UID, RecordKind.REVOCATION, "", epoch, sequence, content))


def member(slot: int, generation: int, endpoint: str = "") -> Member:
    return Member(ReplicaId(UID, slot, generation), endpoint)


endpoints = st.sampled_from(["", "10.0.0.1:7447", "[::1]:7447", "vm.example.org:1"])
states = st.builds(
    SlotState,
    endpoint=endpoints,
    observed_endpoint=endpoints,
    dials_out=st.booleans(),
    services=st.lists(st.sampled_from(["/a", "/b"]), unique=True).map(tuple),
    draining=st.booleans(),
)
counts = st.integers(0, 4)
members = st.lists(
    st.builds(member, st.integers(0, 2), counts, endpoints), max_size=3, unique_by=lambda m: m.id
)
records = st.one_of(
    st.builds(lambda e, v, m: admission(e, v, *m), counts, counts, members),
    st.builds(slot, st.integers(0, 2), counts, counts, states),
    st.builds(
        lambda name, n: signed(Record(UID, RecordKind.ROBOT, name, 1, n, {"dial_in": ""})),
        st.sampled_from(["r1", "r2"]),
        counts,
    ),
    st.builds(
        lambda n: signed(Record(UID, RecordKind.LEASE, "", 1, n, {"at": 1.0, "lasts_s": 60.0})),
        counts,
    ),
)
