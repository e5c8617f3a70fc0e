"""What travels besides the serialised messages: headers, refusals, probes. Pure.

Whatever bytes come in, a decoder returns a value or raises `FrameError`, nothing else: the
peer is another process, perhaps of another version. Each frame begins with its version.

Owns: the bytes. Not here: sending them, and what they mean.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from fogft.core import definitions
from fogft.core.definitions import Definition
from fogft.core.model import LinkState
from fogft.core.names import REQUEST_ID_BYTES
from fogft.core.service_form import LONGEST_S
from fogft.wire.port import Behind, Probe, ProbeAnswer

VERSION = 3
# Beside the version, only towards peers that have said that they know them.
_PACKED = 0x80  # the payload is compressed
_MAY_PACK = 0x40  # the answer may be
_READS_PACKED = 0x20  # the answer may be where the replica finds the link to be thin
TOKEN_BYTES = 8
ROBOT_BYTES_LIMIT = 64
REASON_LIMIT = 64
PROBE_LIMIT = 1024
PROBE_ANSWER_LIMIT = 65536
DETAIL_LIMIT = 500
BEHIND_LIMIT = 128
BEHIND_DETAIL_LIMIT = 100
REMAINING_LIMIT_S = LONGEST_S
CANCEL_LIMIT = 4096
_CANCEL_BYTES_LIMIT = 1 + CANCEL_LIMIT * REQUEST_ID_BYTES

GREETING_LIMIT = 4096

_REQUEST = struct.Struct(f">B{REQUEST_ID_BYTES}sd")
_ANSWER = struct.Struct(f">B{REQUEST_ID_BYTES}s")
_TOKEN = struct.Struct(f">B{TOKEN_BYTES}s")
_GREETING = struct.Struct(f">B{TOKEN_BYTES}sH")
_ORIGIN_AT = _REQUEST.size


class FrameError(ValueError):
    """These bytes are not a frame of this version."""


@dataclass(frozen=True)
class RequestHeader:
    """What precedes a request.

    Attributes:
        request_id: 16 bytes, made by the client proxy.
        remaining_s: Time left when it was sent, in seconds.
        token: Names the robot's connection, so that replies queue apart.
        robot: Who asks.
        packed: The payload is compressed.
        may_pack: The answer may be.
        reads_packed: It may be where the replica itself finds the link to be thin.
    """

    request_id: bytes
    remaining_s: float
    token: bytes
    robot: str
    packed: bool = False
    may_pack: bool = False
    reads_packed: bool = False


@dataclass(frozen=True)
class Greeting:
    """What accompanies a probe: whose connection this is.

    Attributes:
        token: Names the robot's connection; requests under it are the greeter's.
        certificate: The robot's (DER), with the first probe; empty once it was answered.
        signature: Over `greeted_bytes`, with that certificate's key (DER).
    """

    token: bytes
    certificate: bytes = b""
    signature: bytes = b""


def origin(robot: str, token: bytes) -> bytes:
    """Return the part of a request's header that is the same for a whole connection.

    Raises:
        ValueError: The token is not 8 bytes, or the name not 1 to 64 printable bytes.
    """
    name = robot.encode()
    if len(token) != TOKEN_BYTES:
        raise ValueError(f"a token has {TOKEN_BYTES} bytes")
    if not 0 < len(name) <= ROBOT_BYTES_LIMIT or not robot.isprintable():
        raise ValueError(f"a robot's name has 1 to {ROBOT_BYTES_LIMIT} printable bytes: {robot!r}")
    return token + name


def read_origin(origin: bytes) -> tuple[bytes, str]:
    """Return the token and the robot's name of what `origin` wrote.

    Raises:
        FrameError: It is no such thing.
    """
    token, name = origin[:TOKEN_BYTES], origin[TOKEN_BYTES:]
    if not 0 < len(name) <= ROBOT_BYTES_LIMIT:
        raise FrameError(f"a robot's name of {len(name)} bytes")
    try:
        robot = name.decode()
    except UnicodeDecodeError as error:
        raise FrameError("a robot's name that is not UTF-8") from error
    if not robot.isprintable():
        raise FrameError("a robot's name that is not printable")
    return token, robot


def check_remaining(remaining_s: float) -> None:
    """Refuse a remaining time that is none.

    Raises:
        FrameError: It is negative, too long, or no number.
    """
    if not 0 <= remaining_s <= REMAINING_LIMIT_S:  # false for NaN too
        raise FrameError(f"a remaining time of {remaining_s} s")


def encode_request(
    request_id: bytes,
    remaining_s: float,
    origin: bytes,
    *,
    packed: bool = False,
    may_pack: bool = False,
    reads_packed: bool = False,
) -> bytes:
    """Return a request's header; `origin` comes from the function of that name."""
    first = VERSION | _PACKED * packed | _MAY_PACK * may_pack | _READS_PACKED * reads_packed
    return _REQUEST.pack(first, request_id, remaining_s) + origin


def decode_request(frame: bytes) -> RequestHeader:
    """Read a request's header.

    Raises:
        FrameError: It is not one.
    """
    if len(frame) < _ORIGIN_AT:
        raise FrameError(f"a request's header of {len(frame)} bytes")
    first, request_id, remaining_s = _REQUEST.unpack_from(frame)
    _check_first(first, _PACKED | _MAY_PACK | _READS_PACKED)
    check_remaining(remaining_s)
    token, robot = read_origin(frame[_ORIGIN_AT:])
    return RequestHeader(
        request_id,
        remaining_s,
        token,
        robot,
        packed=bool(first & _PACKED),
        may_pack=bool(first & _MAY_PACK),
        reads_packed=bool(first & _READS_PACKED),
    )


def encode_answer(request_id: bytes, *, packed: bool = False) -> bytes:
    """Return an answer's header."""
    return _ANSWER.pack(VERSION | _PACKED * packed, request_id)


def decode_answer(frame: bytes) -> tuple[bytes, bool]:
    """Return the request id of an answer's header, and whether its payload is compressed.

    Raises:
        FrameError: It is not one.
    """
    if len(frame) != _ANSWER.size:
        raise FrameError(f"an answer's header of {len(frame)} bytes")
    first, request_id = _ANSWER.unpack(frame)
    _check_first(first, _PACKED)
    return bytes(request_id), bool(first & _PACKED)


def encode_refusal(request_id: bytes, reason: str) -> bytes:
    """Return a refusal; `reason` is one of `port.Refusal`, or any short ASCII text."""
    return _ANSWER.pack(VERSION, request_id) + reason.encode("ascii")


def decode_refusal(frame: bytes) -> tuple[bytes, str]:
    """Return the request id and the reason of a refusal.

    Raises:
        FrameError: It is not one.
    """
    if len(frame) < _ANSWER.size:
        raise FrameError(f"a refusal of {len(frame)} bytes")
    version, request_id = _ANSWER.unpack_from(frame)
    _check_version(version)
    return bytes(request_id), read_reason(frame[_ANSWER.size :])


def read_reason(said: bytes) -> str:
    """Return the reason of a refusal.

    Raises:
        FrameError: It is none.
    """
    if not 0 < len(said) <= REASON_LIMIT:
        raise FrameError(f"a reason of {len(said)} bytes")
    try:
        reason = said.decode("ascii")
    except UnicodeDecodeError as error:
        raise FrameError("a reason that is not ASCII") from error
    if not reason.isprintable():
        raise FrameError("a reason that is not printable")
    return reason


def greeted_bytes(token: bytes, replica: str) -> bytes:
    """Return what a greeting's signature covers: good for one connection to one replica.

    Args:
        token: The connection's.
        replica: The replica's common name.
    """
    return b"fogft greeting 1\n" + token + replica.encode()


def encode_greeting(greeting: Greeting) -> bytes:
    """Return a greeting, or the bare token where it has no certificate.

    Raises:
        ValueError: It would be too long.
    """
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
    """Read a greeting; nothing in it is verified.

    Raises:
        FrameError: It is not one.
    """
    if len(frame) == _TOKEN.size:
        version, token = _TOKEN.unpack(frame)
        _check_version(version)
        return Greeting(token)
    if not _GREETING.size < len(frame) <= GREETING_LIMIT:
        raise FrameError(f"a greeting of {len(frame)} bytes")
    version, token, length = _GREETING.unpack_from(frame)
    _check_version(version)
    end = _GREETING.size + length
    if not length or end >= len(frame):
        raise FrameError("a greeting that is cut short")
    return Greeting(token, frame[_GREETING.size : end], frame[end:])


def encode_cancel(ids: Sequence[bytes]) -> bytes:
    """Return the ids of requests that are no longer wanted, at most `CANCEL_LIMIT`."""
    return bytes((VERSION,)) + b"".join(ids[:CANCEL_LIMIT])


def decode_cancel(frame: bytes) -> list[bytes]:
    """Return the ids of requests that are no longer wanted.

    Raises:
        FrameError: It is not a list of ids.
    """
    if not frame or (len(frame) - 1) % REQUEST_ID_BYTES or len(frame) > _CANCEL_BYTES_LIMIT:
        raise FrameError(f"a cancellation of {len(frame)} bytes")
    _check_version(frame[0])
    return [frame[at : at + REQUEST_ID_BYTES] for at in range(1, len(frame), REQUEST_ID_BYTES)]


def encode_probe(probe: Probe) -> bytes:
    """Return a probe as compact JSON."""
    written: dict[str, Any] = {
        "v": VERSION,
        "robot": probe.robot,
        "manager_age_s": probe.manager_age_s,
    }
    if probe.describe:
        written["describe"] = True
    return _to_json(written)


def decode_probe(frame: bytes) -> Probe:
    """Read a probe.

    Raises:
        FrameError: It is not one.
    """
    raw = _from_json(frame, PROBE_LIMIT)
    age = raw.get("manager_age_s")
    return Probe(
        _text(raw, "robot"),
        None if age is None else _seconds(raw, "manager_age_s"),
        raw.get("describe") is True,
    )


def encode_probe_answer(answer: ProbeAnswer) -> bytes:
    """Return a probe's answer as compact JSON; a long `detail` is cut.

    Definitions of types are left out where they do not fit.

    Raises:
        ValueError: It names too many services for one frame (64 KiB).
    """
    written = _plain_answer(answer)
    if answer.types:
        types = {name: definitions.to_plain(of) for name, of in answer.types.items()}
        frame = _to_json({**written, "types": types})
        if len(frame) <= PROBE_ANSWER_LIMIT:
            return frame
    frame = _to_json(written)
    if len(frame) > PROBE_ANSWER_LIMIT:
        raise ValueError(f"a probe's answer of {len(frame)} bytes")
    return frame


def _plain_answer(answer: ProbeAnswer) -> dict[str, Any]:
    written: dict[str, Any] = {
        "v": VERSION,
        "slot": answer.slot,
        "generation": answer.generation,
        "incarnation": answer.incarnation,
        "ready": sorted(answer.ready),
        "draining": answer.draining,
        "at_risk": answer.at_risk,
        "restarts": answer.restarts,
        "in_flight": answer.in_flight,
        "work": dict(answer.work),
        "detail": answer.detail[:DETAIL_LIMIT].encode(errors="replace").decode(),
    }
    if answer.offered:
        written["offered"] = dict(answer.offered)
    if answer.accepts:
        written["accepts"] = sorted(answer.accepts)
    if answer.behind:
        written["behind"] = [_behind_plain(one) for one in answer.behind]
    return written


def decode_probe_answer(frame: bytes) -> ProbeAnswer:
    """Read a probe's answer.

    Raises:
        FrameError: It is not one.
    """
    raw = _from_json(frame, PROBE_ANSWER_LIMIT)
    return ProbeAnswer(
        slot=_count(raw, "slot"),
        generation=_count(raw, "generation"),
        incarnation=_text(raw, "incarnation"),
        ready=_names(raw, "ready"),
        draining=_truth(raw, "draining"),
        at_risk=_truth(raw, "at_risk", False),
        restarts=_count(raw, "restarts"),
        in_flight=_count(raw, "in_flight"),
        work=_numbers(raw, "work"),
        detail=_text(raw, "detail"),
        offered=_texts(raw, "offered"),
        types=_types(raw),
        behind=_behind(raw.get("behind", [])),
        accepts=_names(raw, "accepts", []),
    )


def _behind_plain(one: Behind) -> dict[str, Any]:
    detail = one.detail[:BEHIND_DETAIL_LIMIT].encode(errors="replace").decode()
    return {
        **asdict(one),
        "state": one.state.value,
        "ready": sorted(one.ready),
        "silent_for_s": round(one.silent_for_s, 3),
        "rtt_s": None if one.rtt_s is None else round(one.rtt_s, 6),
        "detail": detail,
    }


def _behind(raw: Any) -> tuple[Behind, ...]:
    if not isinstance(raw, list) or len(raw) > BEHIND_LIMIT:
        raise FrameError(f"`behind` is not a list of at most {BEHIND_LIMIT}")
    return tuple(_one_behind(one) for one in raw)


def _one_behind(raw: Any) -> Behind:
    if not isinstance(raw, dict):
        raise FrameError("`behind` holds what is no object")
    try:
        state = LinkState(raw.get("state"))
    except ValueError as error:
        raise FrameError("`state` is none") from error
    return Behind(
        slot=_count(raw, "slot"),
        generation=_count(raw, "generation"),
        state=state,
        ready=_names(raw, "ready"),
        draining=_truth(raw, "draining"),
        at_risk=_truth(raw, "at_risk"),
        silent_for_s=_seconds(raw, "silent_for_s"),
        rtt_s=None if raw.get("rtt_s") is None else _seconds(raw, "rtt_s"),
        restarts=_count(raw, "restarts"),
        detail=_text(raw, "detail"),
        through=_text(raw, "through"),
    )


def _names(raw: dict[str, Any], key: str, default: Any = None) -> frozenset[str]:
    names = raw.get(key, default)
    if not isinstance(names, list):
        raise FrameError(f"`{key}` is not a list of names")
    return frozenset(_check_text(name, key) for name in names)


def _truth(raw: dict[str, Any], key: str, default: Any = None) -> bool:
    value = raw.get(key, default)
    if not isinstance(value, bool):
        raise FrameError(f"`{key}` is neither true nor false")
    return value


def _check_first(first: int, flags: int) -> None:
    if first & ~flags != VERSION:
        _check_version(first)


def _check_version(version: Any) -> None:
    if version is True or version != VERSION:
        raise FrameError(f"version {version!r}, where {VERSION} is spoken here")


def _to_json(value: dict[str, Any]) -> bytes:
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()


def _no_constant(text: str) -> float:
    raise FrameError(f"the number {text}")


def _from_json(frame: bytes, limit: int) -> dict[str, Any]:
    if len(frame) > limit:
        raise FrameError(f"a frame of {len(frame)} bytes")
    try:
        raw = json.loads(frame.decode(), parse_constant=_no_constant)
    except FrameError:
        raise
    except (ValueError, RecursionError) as error:
        raise FrameError("a frame that is not JSON") from error
    if not isinstance(raw, dict):
        raise FrameError("a frame that is not a JSON object")
    _check_version(raw.get("v"))
    return raw


def _text(raw: dict[str, Any], key: str) -> str:
    return _check_text(raw.get(key), key)


def _check_text(value: Any, key: str) -> str:
    if not isinstance(value, str):
        raise FrameError(f"`{key}` is not a text")
    try:
        value.encode()
    except UnicodeEncodeError as error:  # a lone surrogate, which no log can write
        raise FrameError(f"`{key}` is not a text") from error
    return value


def _count(raw: dict[str, Any], key: str) -> int:
    value = raw.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**53:
        raise FrameError(f"`{key}` is not a count")
    return value


def _numbers(raw: dict[str, Any], key: str) -> dict[str, float]:
    found = raw.get(key, {})  # an older replica tells none
    if not isinstance(found, dict):
        raise FrameError(f"`{key}` is not a map of numbers")
    return {_check_text(name, key): _seconds(found, name) for name in found}


def _texts(raw: dict[str, Any], key: str) -> dict[str, str]:
    found = raw.get(key, {})
    if not isinstance(found, dict):
        raise FrameError(f"`{key}` is not a map of texts")
    return {_check_text(name, key): _check_text(value, key) for name, value in found.items()}


def _types(raw: dict[str, Any]) -> dict[str, Definition]:
    found = raw.get("types", {})  # an older replica tells none
    if not isinstance(found, dict):
        raise FrameError("`types` is not a map of definitions")
    try:
        return {_check_text(k, "types"): definitions.from_plain(v) for k, v in found.items()}
    except FrameError:
        raise
    except ValueError as error:
        raise FrameError(f"`types`: {error}") from error


def _seconds(raw: dict[str, Any], key: str) -> float:
    value = raw.get(key)
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not abs(value) < 1e18:
        raise FrameError(f"`{key}` is not a time in seconds")
    return float(value)
