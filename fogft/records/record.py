"""Membership records, each signed by its only allowed writer. Pure.

A record is sent as the bytes of its body, with the writer's certificate and signature over exactly
these bytes, so anybody may pass a record on and nobody can change it.

Not here: merging (`record_set`), what contents mean (`roster`), cryptography (passed in).
"""

import base64
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated, Any, TypeVar

from fogft.model import plain
from fogft.model.credentials import Holder, Role, manager_of
from fogft.model.keys import only
from fogft.model.names import PoolUid
from fogft.model.plain import Count

VERSION = 2
BODY_LIMIT = 180 << 10  # it must fit into a frame, as text
CERTIFICATE_LIMIT = 4 << 10
SIGNATURE_LIMIT = 256
_SIGNED_PREFIX = b"fogft record 1\n"  # a signature for this purpose is valid for no other
_SUBJECT = re.compile(r"([A-Za-z0-9][A-Za-z0-9_.-]{0,63})?")
T = TypeVar("T")

Key = tuple[str, str]
Order = tuple[int, int]


class RecordError(ValueError):
    """Not a record, or not one that its writer may write; `reason` is one word, for counters."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(detail)
        self.reason = reason


class RecordKind(str, Enum):
    """The kind of a record, which determines its writer."""

    ADMISSION = "admission"  # manager: which generation of which slot is admitted
    REVOCATION = "revocation"  # manager: certificates that are no longer valid
    LEASE = "lease"  # manager: how long replicas serve without hearing from it again
    SLOT = "slot"  # replica: its endpoint, services, state and load
    ROBOT = "robot"  # robot: where replicas may dial in
    GATEWAY = "gateway"  # gateway: its endpoint


# The manager writes all other kinds.
_WRITERS = {
    RecordKind.SLOT: Role.REPLICA,
    RecordKind.ROBOT: Role.ROBOT,
    RecordKind.GATEWAY: Role.GATEWAY,
}


@dataclass(frozen=True)
class Record:
    """One statement of one writer, about a slot, a robot, a gateway, or the whole pool."""

    pool_uid: PoolUid
    kind: RecordKind
    subject: Annotated[str, only(_SUBJECT.fullmatch, "a subject")]
    generation: Count  # of the slot or the certificate; the manager's epoch
    sequence: Count  # counts the writer's records within a generation
    content: Mapping[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> Key:
        """The key of the record; it replaces an older one with the same key."""
        return (self.kind.value, self.subject)

    @property
    def order(self) -> Order:
        """The order of the record; a lower one never replaces a higher one."""
        return (self.generation, self.sequence)


@dataclass(frozen=True)
class SignedRecord:
    """A record in its signed form, as sent and stored."""

    body: bytes
    certificate: bytes  # DER
    signature: bytes  # over the body behind `_SIGNED_PREFIX`, with that certificate's key


@dataclass(frozen=True)
class Writer:
    """The writer of a record, by a verified certificate."""

    role: str
    common_name: str


# Takes certificate, signature and the bytes that were signed; raises `RecordError`.
Verify = Callable[[bytes, bytes, bytes], Writer]
# Takes the bytes to sign; returns certificate and signature.
Sign = Callable[[bytes], tuple[bytes, bytes]]


def sign_record(record: Record, sign: Sign) -> SignedRecord:
    """Sign a record. Raises ValueError: it could not be read back, for example as too large."""
    value = {"v": VERSION, **plain.to_plain(record)}
    body = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    if _decode(body) != record:
        raise ValueError("a record that does not survive its own encoding")
    certificate, signature = sign(_SIGNED_PREFIX + body)
    return SignedRecord(body, certificate, signature)


def read_body(signed: SignedRecord) -> Record:
    """Read a record's body; nothing is verified."""
    if len(signed.certificate) > CERTIFICATE_LIMIT or len(signed.signature) > SIGNATURE_LIMIT:
        raise RecordError("malformed", "a certificate or signature that is too long")
    return _decode(signed.body)


def verified_writer(record: Record, signed: SignedRecord, verify: Verify) -> Writer:
    """Return a record's writer after checking signature, certificate and right to write."""
    writer = verify(signed.certificate, signed.signature, _SIGNED_PREFIX + signed.body)
    expected = expected_writer(record)
    if (writer.role, writer.common_name) != (expected.role.value, expected.common_name):
        what = f"{record.kind.value} record {record.subject}".rstrip()
        raise RecordError("writer", f"`{writer.common_name}` may not write the {what}")
    return writer


def expected_writer(record: Record) -> Holder:
    """Return the only holder that may write this record.

    A replica's certificate names its generation: it cannot write a later one's record.
    """
    role, subject = _WRITERS.get(record.kind, Role.MANAGER), record.subject
    if role is Role.MANAGER:
        if subject:
            raise RecordError("malformed", "a manager's record about somebody")
        return manager_of(record.pool_uid)
    if not subject:
        raise RecordError("malformed", "a record about nobody")
    if role is Role.REPLICA and (not subject.isdecimal() or str(int(subject)) != subject):
        raise RecordError("malformed", "a slot that is not a number")
    return Holder(role, subject, record.generation, record.pool_uid)


# -- bytes ----------------------------------------------------------------------------------


def _decode(body: bytes) -> Record:
    raw = read_json(body, BODY_LIMIT)
    check_version(raw)
    record = read(Record, raw)
    expected_writer(record)
    return record


def check_version(raw: Mapping[str, Any]) -> None:
    """Check that a message or record has this version."""
    if raw.get("v") is True or raw.get("v") != VERSION:
        raise RecordError("version", f"version {raw.get('v')!r:.20} is not spoken here")


def read(cls: type[T], raw: Any) -> T:
    """Return plain data as a value of a class. Raises RecordError."""
    try:
        return plain.from_plain(cls, raw)
    except ValueError as error:
        raise RecordError("malformed", str(error)) from error


def read_json(text: bytes, limit: int) -> dict[str, Any]:
    """Return a JSON object of limited size, without NaN and infinities."""
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


def to_plain(signed: SignedRecord) -> dict[str, str]:
    """Return a signed record as JSON data."""
    return {
        "body": signed.body.decode(),
        "certificate": base64.b64encode(signed.certificate).decode(),
        "signature": base64.b64encode(signed.signature).decode(),
    }


def from_plain(raw: Any) -> SignedRecord:
    """Read a signed record from JSON data, without parsing its body."""
    try:
        body, certificate, signature = (raw[k] for k in ("body", "certificate", "signature"))
        signed = SignedRecord(
            body.encode(),
            base64.b64decode(certificate, validate=True),
            base64.b64decode(signature, validate=True),
        )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise RecordError("malformed", "not a signed record") from error
    if len(signed.body) > BODY_LIMIT:
        raise RecordError("malformed", "a record that is too long")
    return signed
