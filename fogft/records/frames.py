"""The messages between a rendezvous and its callers, as bytes. Pure.

Each message is its length, then a JSON object. Whatever bytes come in, and however they are
split, a reader returns messages or raises `RecordError`, and buffers no more than one frame.
"""

import json
import struct
from collections.abc import Iterator, Sequence
from typing import Any

from fogft.model.plain import Count
from fogft.records.record import (
    VERSION,
    Key,
    Order,
    RecordError,
    SignedRecord,
    check_version,
    from_plain,
    read,
    read_json,
    to_plain,
)
from fogft.records.record_set import Digest

FRAME_LIMIT = 256 << 10
NONCE_BYTES = 32
_LENGTH = struct.Struct(">I")
_BATCH_BYTES = 64 << 10
_DIGEST_LIMIT = 4096
_GREETING_PREFIX = b"fogft caller 1\n"  # so that no other signature is valid here


class Unframer:
    """Cuts a stream of bytes into messages."""

    def __init__(self, limit: int = FRAME_LIMIT) -> None:
        self.limit = limit
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[dict[str, Any]]:
        """Yield the messages that are complete now; the rest stays for the next call."""
        self._buffer += data
        while len(self._buffer) >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._buffer)
            if length > self.limit:
                raise RecordError("malformed", f"a frame of {length} bytes")
            end = _LENGTH.size + length
            if len(self._buffer) < end:
                return
            content = bytes(self._buffer[_LENGTH.size : end])
            del self._buffer[:end]
            yield read_json(content, self.limit)


def frame(message: dict[str, Any]) -> bytes:
    """Return a message as bytes."""
    content = json.dumps(message, separators=(",", ":")).encode()
    return _LENGTH.pack(len(content)) + content


def challenge(nonce: bytes, seen_host: str) -> bytes:
    """Return the rendezvous' first message: a nonce to sign, and the caller's host as seen."""
    return frame({"type": "challenge", "v": VERSION, "nonce": nonce.hex(), "seen": seen_host})


def read_challenge(message: dict[str, Any]) -> tuple[bytes, str]:
    """Return nonce and the caller's host as seen."""
    _expect(message, "challenge")
    nonce, seen = message.get("nonce"), message.get("seen")
    if not isinstance(nonce, str) or not isinstance(seen, str) or len(seen) > 64:
        raise RecordError("malformed", "a challenge without nonce")
    return _hex(nonce, NONCE_BYTES), seen if seen.isprintable() else ""


def proof_bytes(purpose: str, nonce: bytes, binding: bytes) -> bytes:
    """Return the bytes that a caller signs, valid once and for one rendezvous."""
    return _GREETING_PREFIX + purpose.encode() + b"\n" + nonce + binding


def greeting(certificate: bytes, signature: bytes) -> bytes:
    """Return the caller's first message: its certificate and the proof."""
    proof = {"certificate": certificate.hex(), "signature": signature.hex()}
    return frame({"type": "greeting", "v": VERSION, **proof})


def read_greeting(message: dict[str, Any]) -> tuple[bytes, bytes]:
    """Return certificate and signature."""
    _expect(message, "greeting")
    certificate, signature = message.get("certificate"), message.get("signature")
    if not isinstance(certificate, str) or not isinstance(signature, str):
        raise RecordError("malformed", "a greeting without proof")
    return _hex(certificate), _hex(signature)


def ping() -> bytes:
    """Return a keep-alive message."""
    return frame({"type": "ping"})


def have(digest: Digest) -> bytes:
    """Return a message with our records' digest, so that the other side can send missing ones."""
    return frame({"type": "have", "digest": [[*key, *order] for key, order in digest.items()]})


def read_have(message: dict[str, Any]) -> dict[Key, Order]:
    """Return the other side's digest."""
    rows = read(tuple[tuple[str, str, Count, Count], ...], message.get("digest"))
    if len(rows) > _DIGEST_LIMIT:
        raise RecordError("malformed", f"a digest of {len(rows)} records")
    return {(kind, subject): (first, then) for kind, subject, first, then in rows}


def records(all: Sequence[SignedRecord]) -> Iterator[bytes]:
    """Yield messages that carry these records, in batches of limited size."""
    batch: list[dict[str, str]] = []
    size = 0
    for one in all:
        plain = to_plain(one)
        length = sum(map(len, plain.values()))
        if batch and size + length > _BATCH_BYTES:
            yield frame({"type": "records", "records": batch})
            batch, size = [], 0
        batch.append(plain)
        size += length
    if batch:
        yield frame({"type": "records", "records": batch})


def read_records(message: dict[str, Any]) -> list[SignedRecord]:
    """Return the records of a message, not verified yet."""
    rows = message.get("records")
    if not isinstance(rows, list):
        raise RecordError("malformed", "records that are no list")
    return [from_plain(row) for row in rows]


def pack(all: Sequence[SignedRecord]) -> bytes:
    """Return records as a single message, for a link."""
    return json.dumps({"v": VERSION, "records": [to_plain(one) for one in all]}).encode()


def unpack(data: bytes) -> list[SignedRecord]:
    """Return the records of `pack`, not verified yet."""
    message = read_json(data, FRAME_LIMIT)
    check_version(message)
    return read_records(message)


def _expect(message: dict[str, Any], kind: str) -> None:
    if message.get("type") != kind:
        raise RecordError("malformed", f"no {kind}")
    check_version(message)


def _hex(text: str, length: int = 0) -> bytes:
    try:
        raw = bytes.fromhex(text)
    except ValueError:
        raise RecordError("malformed", "not hexadecimal") from None
    if length and len(raw) != length:
        raise RecordError("malformed", f"{len(raw)} bytes, where {length} belong")
    return raw
