"""Wire format of topics: a message to a replica, a pull (poll), and its answer. Pure.

They are sent as the payloads of requests and answers, so the rules for those apply to them.
For any input, a decoder returns a value or raises `FrameError`.
"""

import struct
from collections.abc import Sequence

from fogft.errors import FrameError

SESSION_BYTES = 8
BATCH_LIMIT = 1000
_NUMBER_LIMIT = 1 << 63
_HEAD = struct.Struct(f">{SESSION_BYTES}sQ")
_BATCH = struct.Struct(f">{SESSION_BYTES}sQI")
_ENTRY = struct.Struct(">QI")
NO_SESSION = bytes(SESSION_BYTES)


def encode_message(session: bytes, number: int, message: bytes) -> bytes:
    """Encode a robot's message: publisher session (random at its start), number, CDR."""
    return _HEAD.pack(session, number) + message


def decode_message(frame: bytes) -> tuple[bytes, int, bytes]:
    """Decode a robot's message. Raises FrameError."""
    if len(frame) < _HEAD.size:
        raise FrameError(f"a message of {len(frame)} bytes")
    session, number = _HEAD.unpack_from(frame)
    _check(number)
    return session, number, frame[_HEAD.size :]


def encode_pull(session: bytes, after: int) -> bytes:
    """Encode a pull of a session's messages after a number; `NO_SESSION` asks where to begin."""
    return _HEAD.pack(session, after)


def decode_pull(frame: bytes) -> tuple[bytes, int]:
    """Decode a pull. Raises FrameError."""
    if len(frame) != _HEAD.size:
        raise FrameError(f"a pull of {len(frame)} bytes")
    session, after = _HEAD.unpack(frame)
    _check(after)
    return session, after


def encode_batch(session: bytes, after: int, messages: Sequence[tuple[int, bytes]]) -> bytes:
    """Encode the answer to a pull: session, number to continue from, numbered messages."""
    parts = [_BATCH.pack(session, after, len(messages))]
    for number, message in messages:
        parts += [_ENTRY.pack(number, len(message)), message]
    return b"".join(parts)


def decode_batch(frame: bytes) -> tuple[bytes, int, list[tuple[int, bytes]]]:
    """Decode the answer to a pull. Raises FrameError."""
    if len(frame) < _BATCH.size:
        raise FrameError(f"a batch of {len(frame)} bytes")
    session, after, count = _BATCH.unpack_from(frame)
    _check(after)
    if session == NO_SESSION:
        raise FrameError("a batch of no session")
    if count > BATCH_LIMIT:
        raise FrameError(f"a batch of {count} messages")
    at, messages = _BATCH.size, []
    for _ in range(count):
        if at + _ENTRY.size > len(frame):
            raise FrameError("a batch that is cut short")
        number, size = _ENTRY.unpack_from(frame, at)
        _check(number)
        at += _ENTRY.size
        if at + size > len(frame):
            raise FrameError("a batch that is cut short")
        messages.append((number, frame[at : at + size]))
        at += size
    if at != len(frame):
        raise FrameError("a batch with more behind it")
    return session, after, messages


def _check(number: int) -> None:
    if number >= _NUMBER_LIMIT:
        raise FrameError(f"the number {number}")
