"""Probes and their answers, as JSON: what is added later, an older peer does not look at. Pure.

Like `frame`: a decoder returns a value or raises `FrameError`, whatever bytes come in.

Owns: the bytes. Not here: sending them, and what they mean.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from fogft.errors import FrameError
from fogft.link.frame import VERSION, check_version
from fogft.link.port import GatewayView, Probe, ProbeAnswer
from fogft.model.plain import from_plain, to_plain
from fogft.model.replica import LinkState
from fogft.model.type_definition import Definition

PROBE_LIMIT = 1024
PROBE_ANSWER_LIMIT = 65536
DETAIL_LIMIT = 500
BEHIND_LIMIT = 128
BEHIND_DETAIL_LIMIT = 100


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
    """Read a probe. Raises FrameError: it is not one."""
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
        types = {name: to_plain(of) for name, of in answer.types.items()}
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
    """Read a probe's answer. Raises FrameError: it is not one."""
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


def _behind_plain(one: GatewayView) -> dict[str, Any]:
    detail = one.detail[:BEHIND_DETAIL_LIMIT].encode(errors="replace").decode()
    return {
        **asdict(one),
        "state": one.state.value,
        "ready": sorted(one.ready),
        "silent_for_s": round(one.silent_for_s, 3),
        "rtt_s": None if one.rtt_s is None else round(one.rtt_s, 6),
        "detail": detail,
    }


def _behind(raw: Any) -> tuple[GatewayView, ...]:
    if not isinstance(raw, list) or len(raw) > BEHIND_LIMIT:
        raise FrameError(f"`behind` is not a list of at most {BEHIND_LIMIT}")
    return tuple(_one_behind(one) for one in raw)


def _one_behind(raw: Any) -> GatewayView:
    if not isinstance(raw, dict):
        raise FrameError("`behind` holds what is no object")
    try:
        state = LinkState(raw.get("state"))
    except ValueError as error:
        raise FrameError("`state` is none") from error
    return GatewayView(
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
    check_version(raw.get("v"))
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
        return {_check_text(k, "types"): from_plain(Definition, v) for k, v in found.items()}
    except FrameError:
        raise
    except ValueError as error:
        raise FrameError(f"`types`: {error}") from error


def _seconds(raw: dict[str, Any], key: str) -> float:
    value = raw.get(key)
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not abs(value) < 1e18:
        raise FrameError(f"`{key}` is not a time in seconds")
    return float(value)
