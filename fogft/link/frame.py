"""The bytes of headers, refusals, greetings and cancellations. Pure.

Whatever bytes come in, a decoder returns a value or raises `FrameError`, nothing else: the peer may
be of another version. Each frame begins with its version. Other frames: `probe_frames`,
`batch_frames`, `fogft.records.frames`, `fogft.topics.frames`.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

from fogft.errors import FrameError
from fogft.model.keys import LONGEST_S
from fogft.model.names import REQUEST_ID_BYTES, ROBOT_BYTES_LIMIT
from fogft.requests.load import Handling, Load

VERSION = 5
_ANSWER_PACKED = 0x80  # beside the version: the payload is compressed
# Of a request:
_PACKED = 0x01  # the payload is compressed
_MAY_PACK = 0x02  # the answer may be
_READS_PACKED = 0x04  # the answer may be where the replica finds the link to be thin
_HANDLINGS = {int(one): one for one in (Handling.NORMAL, Handling.DROP_IF_BUSY, Handling.ALONE)}
_PACKING = _PACKED | _MAY_PACK | _READS_PACKED
TOKEN_BYTES = 8
STAMP_BYTES = 4
NO_STAMP = bytes(STAMP_BYTES)  # nothing was seen yet, or nobody asks
REASON_LIMIT = 64
CANCEL_LIMIT = 4096
_CANCEL_BYTES_LIMIT = 1 + CANCEL_LIMIT * REQUEST_ID_BYTES

GREETING_LIMIT = 4096

_REQUEST = struct.Struct(f">BB{REQUEST_ID_BYTES}sd{STAMP_BYTES}s")
_LOAD = struct.Struct(">HBBff")
LOAD_BYTES = _LOAD.size
NO_LOAD = bytes(LOAD_BYTES)  # of a replica whose service time is not known
_ANSWER = struct.Struct(f">B{STAMP_BYTES}s{REQUEST_ID_BYTES}s{LOAD_BYTES}s")
_TOKEN = struct.Struct(f">B{TOKEN_BYTES}s")
_GREETING = struct.Struct(f">B{TOKEN_BYTES}sH")
_ORIGIN_AT = _REQUEST.size


class RequestHeader(NamedTuple):  # made for each request: a frozen dataclass costs thrice as much
    """The header of a request."""

    request_id: bytes  # 16 bytes, made by the client proxy
    remaining_s: float  # when it was sent
    token: bytes  # names the robot's connection, so that replies queue apart
    robot: str
    seen: bytes = NO_STAMP  # of the last answer that its connection has seen
    packed: bool = False
    may_pack: bool = False
    reads_packed: bool = False
    handling: Handling = Handling.NORMAL


@dataclass(frozen=True)
class Greeting:
    """Sent with a probe to authenticate the connection."""

    token: bytes  # names the connection; requests under it are the greeter's
    certificate: bytes = b""  # the robot's (DER), with the first probe; empty once it was answered
    signature: bytes = b""  # over `greeted_bytes`, with that certificate's key (DER)


def origin(robot: str, token: bytes) -> bytes:
    """Return the prefix of all headers of a connection. Raises ValueError: they cannot have it."""
    name = robot.encode()
    if len(token) != TOKEN_BYTES:
        raise ValueError(f"a token has {TOKEN_BYTES} bytes")
    if not 0 < len(name) <= ROBOT_BYTES_LIMIT or not robot.isprintable():
        raise ValueError(f"a robot's name has 1 to {ROBOT_BYTES_LIMIT} printable bytes: {robot!r}")
    return token + name


@lru_cache(maxsize=256)  # a robot says the same in each request of a connection
def read_origin(origin: bytes) -> tuple[bytes, str]:
    """Return the token and the robot's name of what `origin` wrote."""
    name = origin[TOKEN_BYTES:]
    return origin[:TOKEN_BYTES], _read_text(name, "a robot's name", ROBOT_BYTES_LIMIT, "UTF-8")


def _read_text(said: bytes, what: str, limit: int, encoding: str) -> str:
    if not 0 < len(said) <= limit:
        raise FrameError(f"{what} of {len(said)} bytes")
    try:
        text = said.decode(encoding)
    except UnicodeDecodeError as error:
        raise FrameError(f"{what} that is not {encoding}") from error
    if not text.isprintable():
        raise FrameError(f"{what} that is not printable")
    return text


# Returns the reason of a refusal.
read_reason = partial(_read_text, what="a reason", limit=REASON_LIMIT, encoding="ASCII")


def encode_request(
    request_id: bytes,
    remaining_s: float,
    origin: bytes,
    *,
    seen: bytes = NO_STAMP,
    packed: bool = False,
    may_pack: bool = False,
    reads_packed: bool = False,
    handling: Handling = Handling.NORMAL,
) -> bytes:
    """Return a request's header; `origin` comes from the function of that name."""
    flags = int(handling)
    flags |= _PACKED * packed | _MAY_PACK * may_pack | _READS_PACKED * reads_packed
    return _REQUEST.pack(VERSION, flags, request_id, remaining_s, seen) + origin


def decode_request(frame: bytes) -> RequestHeader:
    """Read a request's header."""
    if len(frame) < _ORIGIN_AT:
        raise FrameError(f"a request's header of {len(frame)} bytes")
    version, flags, request_id, remaining_s, seen = _REQUEST.unpack_from(frame)
    if version != VERSION:
        check_version(version)
    handling = read_handling(flags & ~_PACKING, remaining_s)
    packing = flags & _PACKED != 0, flags & _MAY_PACK != 0, flags & _READS_PACKED != 0
    # `RequestHeader(...)` would be one more call of Python.
    return tuple.__new__(
        RequestHeader,
        (request_id, remaining_s, *read_origin(frame[_ORIGIN_AT:]), seen, *packing, handling),
    )


def read_handling(flags: int, remaining_s: float) -> Handling:
    """Read how a replica is to handle a request; refuse a time that is negative or too long."""
    handling = _HANDLINGS.get(flags)
    if handling is None:
        raise FrameError(f"a request with flags {flags:#x}")
    if not 0 <= remaining_s <= LONGEST_S:  # false for NaN too
        raise FrameError(f"a remaining time of {remaining_s} s")
    return handling


def encode_load(load: Load | None) -> bytes:
    """Encode a replica's load in `LOAD_BYTES`; larger values are capped."""
    if load is None:
        return NO_LOAD
    waiting, running, slots, service_s, spent_s = load
    return _LOAD.pack(
        min(waiting, 0xFFFF), min(running, 0xFF), min(slots, 0xFF), service_s, spent_s
    )


def decode_load(frame: bytes) -> Load | None:
    """Decode a replica's load; None if it gives none. `frame` has `LOAD_BYTES`."""
    if frame == NO_LOAD:
        return None
    load = tuple.__new__(Load, _LOAD.unpack(frame))
    if not (0 <= load.service_s <= LONGEST_S and 0 <= load.spent_s <= LONGEST_S):
        raise FrameError(f"a load of {load.service_s} s and {load.spent_s} s")
    return load


def encode_answer(
    stamp: bytes, request_id: bytes, *, load: bytes = NO_LOAD, packed: bool = False
) -> bytes:
    """Return an answer's header; `load` comes from `encode_load`."""
    return _ANSWER.pack(VERSION | _ANSWER_PACKED * packed, stamp, request_id, load)


def decode_answer(frame: bytes) -> tuple[bytes, bytes, Load | None, bool]:
    """Return stamp, request id and load of an answer's header, and whether it is compressed."""
    if len(frame) != _ANSWER.size:
        raise FrameError(f"an answer's header of {len(frame)} bytes")
    first, stamp, request_id, load = _ANSWER.unpack(frame)
    if first != VERSION:
        check_version(first & ~_ANSWER_PACKED)
    return stamp, request_id, decode_load(load), first != VERSION


def encode_refusal(stamp: bytes, request_id: bytes, reason: str, load: bytes = NO_LOAD) -> bytes:
    """Return a refusal; `reason` is one of `model.refusal`, or any short ASCII text."""
    return _ANSWER.pack(VERSION, stamp, request_id, load) + reason.encode("ascii")


def decode_refusal(frame: bytes) -> tuple[bytes, bytes, str, Load | None]:
    """Return the stamp, the request id, the reason and the load of a refusal."""
    if len(frame) < _ANSWER.size:
        raise FrameError(f"a refusal of {len(frame)} bytes")
    version, stamp, request_id, load = _ANSWER.unpack_from(frame)
    check_version(version)
    return stamp, request_id, read_reason(frame[_ANSWER.size :]), decode_load(load)


def greeted_bytes(token: bytes, replica: str) -> bytes:
    """Return the bytes that a greeting's signature covers: one connection, one replica's name."""
    return b"fogft greeting 1\n" + token + replica.encode()


def encode_greeting(greeting: Greeting) -> bytes:
    """Return a greeting; without a certificate the token. Raises ValueError: too long."""
    if not greeting.certificate:
        return _TOKEN.pack(VERSION, greeting.token)
    frame = (
        _GREETING.pack(VERSION, greeting.token, len(greeting.certificate))
        + greeting.certificate
        + greeting.signature
    )
    if len(frame) > GREETING_LIMIT:
        raise ValueError(f"a greeting of {len(frame)} bytes")
    return frame


def decode_greeting(frame: bytes) -> Greeting:
    """Read a greeting; nothing in it is verified."""
    if len(frame) == _TOKEN.size:
        version, token = _TOKEN.unpack(frame)
        check_version(version)
        return Greeting(token)
    if not _GREETING.size < len(frame) <= GREETING_LIMIT:
        raise FrameError(f"a greeting of {len(frame)} bytes")
    version, token, length = _GREETING.unpack_from(frame)
    check_version(version)
    end = _GREETING.size + length
    if not length or end >= len(frame):
        raise FrameError("a greeting that is cut short")
    return Greeting(token, frame[_GREETING.size : end], frame[end:])


def encode_cancel(ids: Sequence[bytes]) -> bytes:
    """Return the ids of requests that are no longer wanted, at most `CANCEL_LIMIT`."""
    return bytes((VERSION,)) + b"".join(ids[:CANCEL_LIMIT])


def decode_cancel(frame: bytes) -> list[bytes]:
    """Return the ids of requests that are no longer wanted."""
    if not frame or (len(frame) - 1) % REQUEST_ID_BYTES or len(frame) > _CANCEL_BYTES_LIMIT:
        raise FrameError(f"a cancellation of {len(frame)} bytes")
    check_version(frame[0])
    return [frame[at : at + REQUEST_ID_BYTES] for at in range(1, len(frame), REQUEST_ID_BYTES)]


def check_version(version: Any) -> None:
    """Check the link version of a frame. Raises FrameError: it is not this version."""
    if version is True or version != VERSION:
        older = isinstance(version, int) and version < VERSION
        raise FrameError(
            f"link version {version!r:.20} there and {VERSION} here: upgrade fogft "
            + ("there" if older else "here")
        )
