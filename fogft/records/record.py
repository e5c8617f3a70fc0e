"""Membership records: who is where, said by the one who may say it, and signed. Pure.

A record has one key (kind and subject), one writer, and an order (generation, sequence).
What travels is its body as bytes, with the writer's certificate and signature over exactly
these bytes, so anybody may pass a record on and nobody can change it. Whatever comes in, a
reader returns a value or raises `RecordError`.

Owns: the bytes of records, and who may write which.
Not here: merging (`record_set`), what contents mean (`roster`), cryptography (passed in).
"""

from __future__ import annotations

import base64
import binascii
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from fogft.model import names
from fogft.model.replica import ReplicaId

VERSION = 1
BODY_LIMIT = 64 << 10
CERTIFICATE_LIMIT = 4 << 10
SIGNATURE_LIMIT = 256
COUNT_LIMIT = 2**53
_SIGNED_PREFIX = b"fogft record 1\n"  # a signature for this purpose is good for no other
_SUBJECT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")

Key = tuple[str, str]
Order = tuple[int, int]


class RecordError(ValueError):
    """This is no record, or not one that its writer may write.

    Args:
        reason: One word for counters: ``malformed``, ``version``, ``pool``, ``forged``,
            ``writer``, ``authority``, ``expired``, ``revoked``.
        detail: The same for people.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(detail)
        self.reason = reason


class RecordKind(str, Enum):
    """What a record is about; its writer follows from it."""

    ADMISSION = "admission"  # manager: which generation of which slot is let in
    TOPOLOGY = "topology"  # manager: who talks through whom
    REVOCATION = "revocation"  # manager: certificates that are good no more
    LEASE = "lease"  # manager: how long replicas serve without hearing of it again
    SLOT = "slot"  # replica: its endpoint, services, state and load
    ROBOT = "robot"  # robot: where replicas may dial in
    GATEWAY = "gateway"  # gateway: its endpoint


MANAGER_KINDS = frozenset(
    {RecordKind.ADMISSION, RecordKind.TOPOLOGY, RecordKind.REVOCATION, RecordKind.LEASE}
)


@dataclass(frozen=True)
class Record:
    """One statement of one writer.

    Attributes:
        subject: The slot, the robot's or the gateway's name; empty where the pool is meant.
        generation: The slot's, the manager's epoch, or that of the robot's or gateway's
            certificate.
        sequence: Counts what the writer wrote within a generation.
        content: Plain JSON data; `roster` knows what it means.
    """

    pool_uid: str
    kind: RecordKind
    subject: str
    generation: int
    sequence: int
    content: Mapping[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> Key:
        """What this record replaces: an older one of the same key."""
        return (self.kind.value, self.subject)

    @property
    def order(self) -> Order:
        """A lower one never replaces a higher one."""
        return (self.generation, self.sequence)


@dataclass(frozen=True)
class SignedRecord:
    """A record as it travels and is kept.

    Attributes:
        body: The record's bytes, as its writer signed them.
        certificate: The writer's certificate (DER).
        signature: Over `signed_bytes(body)`, with that certificate's key (DER).
    """

    body: bytes
    certificate: bytes
    signature: bytes


@dataclass(frozen=True)
class Writer:
    """Who signed something, by a certificate that was found to be good.

    Attributes:
        role: ``manager``, ``replica``, ``robot``, ``gateway``, ``rendezvous``.
        common_name: From `model.names`.
        serial: The certificate's serial number, lower-case hexadecimal.
    """

    role: str
    common_name: str
    serial: str


# Takes certificate, signature and the bytes that were signed; raises `RecordError`.
Verify = Callable[[bytes, bytes, bytes], Writer]
# Takes the bytes to sign; returns certificate and signature.
Sign = Callable[[bytes], tuple[bytes, bytes]]


def signed_bytes(body: bytes) -> bytes:
    """Return what a record's signature covers."""
    return _SIGNED_PREFIX + body


def sign_record(record: Record, sign: Sign) -> SignedRecord:
    """Return a record as it travels.

    Raises:
        ValueError: It could not be read back: too large, or not JSON data.
    """
    body = _encode(record)
    if _decode(body) != record:
        raise ValueError("a record that does not survive its own encoding")
    certificate, signature = sign(signed_bytes(body))
    return SignedRecord(body, certificate, signature)


def read_body(signed: SignedRecord) -> Record:
    """Return what a record says, whoever wrote it: nothing is verified.

    Raises:
        RecordError: It is no record of this version.
    """
    if len(signed.certificate) > CERTIFICATE_LIMIT or len(signed.signature) > SIGNATURE_LIMIT:
        raise RecordError("malformed", "a certificate or signature that is too long")
    return _decode(signed.body)


def verified_writer(record: Record, signed: SignedRecord, verify: Verify) -> Writer:
    """Return who wrote a record, once signature, certificate and right to write are checked.

    Raises:
        RecordError: One of them is wrong.
    """
    writer = verify(signed.certificate, signed.signature, signed_bytes(signed.body))
    role, common_name = expected_writer(record)
    if (writer.role, writer.common_name) != (role, common_name):
        what = f"{record.kind.value} record {record.subject}".rstrip()
        raise RecordError("writer", f"`{writer.common_name}` may not write the {what}")
    return writer


def expected_writer(record: Record) -> tuple[str, str]:
    """Return role and common name of the only one who may write this record.

    A replica's certificate names its generation: it cannot write a later one's record.

    Raises:
        RecordError: There can be no such record.
    """
    uid, subject = record.pool_uid, record.subject
    if record.kind in MANAGER_KINDS:
        if subject:
            raise RecordError("malformed", "a manager's record about somebody")
        return "manager", names.manager_certificate_name(uid)
    if record.kind is RecordKind.SLOT:
        if not subject.isdecimal() or str(int(subject)) != subject:
            raise RecordError("malformed", "a slot that is not a number")
        id = ReplicaId(uid, int(subject), record.generation)
        return "replica", id.certificate_name
    if not subject:
        raise RecordError("malformed", "a record about nobody")
    if record.kind is RecordKind.ROBOT:
        return "robot", names.robot_certificate_name(uid, subject, record.generation)
    return "gateway", names.gateway_certificate_name(uid, subject, record.generation)


# -- bytes ----------------------------------------------------------------------------------


def _encode(record: Record) -> bytes:
    value = {
        "v": VERSION,
        "pool": record.pool_uid,
        "kind": record.kind.value,
        "subject": record.subject,
        "generation": record.generation,
        "sequence": record.sequence,
        "content": record.content,
    }
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def _decode(body: bytes) -> Record:
    raw = read_json(body, BODY_LIMIT)
    if raw.get("v") is True or raw.get("v") != VERSION:
        raise RecordError("version", f"a record of version {raw.get('v')!r:.20}")
    uid, subject, content = raw.get("pool"), raw.get("subject"), raw.get("content")
    if not isinstance(uid, str) or not names.POOL_UID_PATTERN.fullmatch(uid):
        raise RecordError("malformed", "a record without a pool")
    if not isinstance(subject, str) or (subject and not _SUBJECT.fullmatch(subject)):
        raise RecordError("malformed", "a record with an odd subject")
    if not isinstance(content, dict):
        raise RecordError("malformed", "a record without content")
    try:
        kind = RecordKind(raw.get("kind"))
    except ValueError:
        raise RecordError("malformed", "a record of an unknown kind") from None
    record = Record(
        uid, kind, subject, _count(raw.get("generation")), _count(raw.get("sequence")), content
    )
    expected_writer(record)
    return record


def read_json(text: bytes, limit: int) -> dict[str, Any]:
    """Return a JSON object of limited size, without numbers that are none.

    Raises:
        RecordError: It is anything else.
    """
    if len(text) > limit:
        raise RecordError("malformed", f"{len(text)} bytes, where {limit} are the limit")
    try:
        raw = json.loads(text.decode(), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise RecordError("malformed", "not JSON") from error
    if not isinstance(raw, dict):
        raise RecordError("malformed", "not a JSON object")
    return raw


def _no_constant(text: str) -> float:
    raise ValueError(text)


def _count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < COUNT_LIMIT:
        raise RecordError("malformed", "a count that is none")
    return value


def to_plain(signed: SignedRecord) -> dict[str, str]:
    """Return a signed record as JSON data."""
    return {
        "body": signed.body.decode(),
        "certificate": base64.b64encode(signed.certificate).decode(),
        "signature": base64.b64encode(signed.signature).decode(),
    }


def from_plain(raw: Any) -> SignedRecord:
    """Read a signed record from JSON data; its body is not looked at.

    Raises:
        RecordError: It is none.
    """
    try:
        body, certificate, signature = (raw[k] for k in ("body", "certificate", "signature"))
        signed = SignedRecord(
            body.encode(),
            base64.b64decode(certificate, validate=True),
            base64.b64decode(signature, validate=True),
        )
    except (KeyError, TypeError, AttributeError, ValueError, binascii.Error) as error:
        raise RecordError("malformed", "not a signed record") from error
    if len(signed.body) > BODY_LIMIT:
        raise RecordError("malformed", "a record that is too long")
    return signed
