"""Wire format of a batch: several small requests, or several small answers, in one message. Pure.

A message costs both ends far more than the few bytes in it. As in `frame`, decoders return a value
or raise `FrameError`. `window` and `reply_queue` decide what is batched.
"""

import struct
from collections.abc import Sequence
from typing import Any

from fogft.errors import FrameError
from fogft.link import frame
from fogft.link.port import Answer
from fogft.model import refusal
from fogft.model.names import REQUEST_ID_BYTES

LIMIT = 64  # entries
ENTRY_BYTES_LIMIT = 4 << 10  # a larger payload is sent alone: it neither waits nor delays others
BYTES_LIMIT = 16 << 10  # of all payloads together

BATCH = bytes((frame.VERSION | 0x10,))  # the first byte of a batch's header
_STAMPED = len(BATCH) + frame.STAMP_BYTES
_REQUEST = struct.Struct(f">{REQUEST_ID_BYTES}sdBI")  # id, remaining seconds, handling, length
_ANSWER = struct.Struct(f">{REQUEST_ID_BYTES}s{frame.LOAD_BYTES}s?I")  # ..., refusal, length

Requests = Sequence[tuple[bytes, float, int, bytes]]  # id, remaining seconds, handling, payload
Answers = Sequence[tuple[bytes, bytes, bytes, str]]  # id, load, payload, refusal


def encode_requests(
    requests: Requests, origin: bytes, *, seen: bytes = frame.NO_STAMP
) -> tuple[bytes, bytes]:
    """Return header and payload for at most `LIMIT` requests; `seen` is the last answer's stamp."""
    parts = []
    for id, remaining_s, handling, payload in requests:
        parts.append(_REQUEST.pack(id, remaining_s, handling, len(payload)))
        parts.append(payload)
    return BATCH + seen + origin, b"".join(parts)


def decode_requests(header: bytes, payload: bytes) -> list[tuple[frame.RequestHeader, bytes]]:
    """Return the requests of a batch, each with its own header. Raises FrameError."""
    if header[:1] != BATCH:
        raise FrameError("no batch of requests")
    seen = header[1:_STAMPED]
    token, robot = frame.read_origin(header[_STAMPED:])
    found = []
    for (id, remaining_s, flags, _), part in _entries(_REQUEST, payload):
        handling = frame.read_handling(flags, remaining_s)
        one = frame.RequestHeader(id, remaining_s, token, robot, seen, handling=handling)
        found.append((one, part))
    return found


def encode_answers(stamp: bytes, answers: Answers) -> tuple[bytes, bytes]:
    """Return header and payload for a batch of answers."""
    parts = []
    for id, load, payload, reason in answers:
        said = reason.encode("ascii") if reason else payload
        parts.append(_ANSWER.pack(id, load, bool(reason), len(said)))
        parts.append(said)
    return BATCH + stamp, b"".join(parts)


def decode_answers(header: bytes, payload: bytes) -> tuple[bytes, list[Answer]]:
    """Return the stamp and the answers of a batch. Raises FrameError: it is not one."""
    if header[:1] != BATCH or len(header) != _STAMPED:
        raise FrameError("no batch of answers")
    found = []
    for (id, said, refused, _), part in _entries(_ANSWER, payload):
        load = frame.decode_load(said)
        if refused:
            kind, detail = refusal.read(frame.read_reason(part))
            found.append(Answer(id, refusal=kind, detail=detail, load=load))
        else:
            found.append(Answer(id, part, load=load))
    return header[1:], found


def _entries(form: struct.Struct, payload: bytes) -> list[tuple[tuple[Any, ...], bytes]]:
    """Return each entry's fields (the last one is its length) and its bytes."""
    found = []
    at, end = 0, len(payload)
    while at < end:
        begin = at + form.size
        if begin > end:
            raise FrameError("a batch that is cut short")
        fields = form.unpack_from(payload, at)
        at = begin + fields[-1]
        if at > end:
            raise FrameError("a batch that is cut short")
        found.append((fields, payload[begin:at]))
        if len(found) > LIMIT:
            raise FrameError(f"a batch of more than {LIMIT}")
    if not found:
        raise FrameError("an empty batch")
    return found
