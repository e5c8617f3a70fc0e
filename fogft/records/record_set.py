"""Records merged by (generation, sequence): their order of arrival does not matter. Pure.

Not here: a record's bytes (`record`), its meaning (`roster`), sending it (`exchange`).
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from fogft.records.record import (
    Key,
    Order,
    Record,
    RecordError,
    RecordKind,
    SignedRecord,
    Verify,
    Writer,
    read_body,
    verified_writer,
)
from fogft.records.roster import READERS, revoked_names

KEYS_LIMIT = 1024

Digest = Mapping[Key, Order]


class Verdict(str, Enum):
    """The verdict on an offered record."""

    ACCEPTED = "accepted"
    KNOWN = "known"  # the same one is held already
    OLDER = "older"  # a later one is held
    REFUSED = "refused"  # invalid; the counters say why


@dataclass(frozen=True)
class Held:
    """The latest record of a key, verified."""

    record: Record
    signed: SignedRecord
    writer: Writer


class RecordSet:
    """The records of one pool, up to a limit of keys. Not thread-safe."""

    def __init__(self, pool_uid: str, verify: Verify, *, limit: int = KEYS_LIMIT) -> None:
        self.pool_uid = pool_uid
        self.counts: Counter[str] = Counter()
        self.last_refusal = ""
        self._verify = verify
        self._limit = limit
        self._held: dict[Key, Held] = {}
        self.revoked: frozenset[str] = frozenset()  # common names of certificates

    def offer(self, signed: SignedRecord, verify: Verify | None = None) -> Verdict:
        """Add a record if it is valid, by `verify` or the usual check, and newer than its key's."""
        try:
            verdict = self._judge(signed, verify or self._verify)
        except RecordError as error:
            self.counts[f"refused_{error.reason}"] += 1
            self.last_refusal = str(error)
            return Verdict.REFUSED
        self.counts[verdict.value] += 1
        return verdict

    def _judge(self, signed: SignedRecord, verify: Verify) -> Verdict:
        record = read_body(signed)
        if record.pool_uid != self.pool_uid:
            raise RecordError("pool", "a record of another pool")
        held = self._held.get(record.key)
        if held is not None:
            # If a writer published two under one number, all peers must settle on the same one.
            new, old = (record.order, signed.body), (held.record.order, held.signed.body)
            if new <= old:
                return Verdict.KNOWN if new == old else Verdict.OLDER
        READERS[record.kind](record)
        if held is None and len(self._held) >= self._limit:
            raise RecordError("full", f"a record beyond the {self._limit} that are kept")
        # Last, being the costly step: a flood of old records costs no signature checks.
        writer = verified_writer(record, signed, verify)
        if writer.common_name in self.revoked:
            raise RecordError("revoked", f"the certificate of `{writer.common_name}` is revoked")
        self._held[record.key] = Held(record, signed, writer)
        if record.kind is RecordKind.REVOCATION:
            self._revoke(revoked_names(record))
        return Verdict.ACCEPTED

    def _revoke(self, names: frozenset[str]) -> None:
        """Drop records that revoked certificates have signed, whatever their order."""
        self.revoked = names
        for key in [k for k, held in self._held.items() if held.writer.common_name in names]:
            if key[0] != RecordKind.REVOCATION.value:
                del self._held[key]

    def digest(self) -> dict[Key, Order]:
        """Return the current order of each key."""
        return {key: held.record.order for key, held in self._held.items()}

    def lacking(self, digest: Digest) -> list[SignedRecord]:
        """Return the records missing from a digest; the manager's first."""
        return [
            held.signed
            for key, held in sorted(self._held.items(), key=lambda item: _urgency(item[0]))
            if held.record.order > digest.get(key, (-1, -1))
        ]

    def __len__(self) -> int:
        return len(self._held)

    def get(self, kind: RecordKind, subject: str = "") -> Held | None:
        """Return the latest record of a key; None without one."""
        return self._held.get((kind.value, subject))

    def of(self, kind: RecordKind) -> list[Record]:
        """Return all records of a kind, by subject."""
        return [held.record for key, held in sorted(self._held.items()) if key[0] == kind.value]


def _urgency(key: Key) -> tuple[bool, bool, Key]:
    # Revocations first, then admission: the other records are judged by them.
    return (key[0] != RecordKind.REVOCATION.value, key[0] != RecordKind.ADMISSION.value, key)
