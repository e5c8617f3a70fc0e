"""Wire format of probes and their answers: JSON; older peers ignore keys added later. Pure.

As in `frame`, a decoder returns a value or raises `FrameError`, for any input.
"""

import json
from dataclasses import replace
from functools import lru_cache
from typing import TypeVar

from fogft.errors import FrameError
from fogft.link.frame import VERSION, check_version
from fogft.link.port import GatewayView, Probe, ProbeAnswer
from fogft.model.plain import as_line, from_plain, to_plain
from fogft.records.record import read_json

T = TypeVar("T")
PROBE_LIMIT = 1024
PROBE_ANSWER_LIMIT = 256 << 10  # room for `NAMES_BYTES_LIMIT` twice, and types
DETAIL_LIMIT = 500
BEHIND_LIMIT = 128
BEHIND_DETAIL_LIMIT = 100


@lru_cache(maxsize=16)  # a robot's probes are all the same
def encode_probe(probe: Probe) -> bytes:
    """Return a probe as compact JSON."""
    return _encoded(probe)


@lru_cache(maxsize=128)
def decode_probe(frame: bytes) -> Probe:
    """Read a probe. Raises FrameError: it is not one."""
    return _decoded(Probe, frame, PROBE_LIMIT)


def encode_probe_answer(answer: ProbeAnswer) -> bytes:
    """Return a probe's answer as compact JSON; a long `detail` is cut.

    If it does not fit, the second half of the type definitions is left out, then of the rest; then
    so is `behind`. Raises ValueError: it names more services than any pool file may.
    """
    behind = tuple(_shortened(one) for one in answer.behind)
    written = replace(answer, detail=as_line(answer.detail[:DETAIL_LIMIT]), behind=behind)
    frame = _encoded(written)
    while len(frame) > PROBE_ANSWER_LIMIT and (written.types or written.behind):
        kept = written.behind if written.types else written.behind[: len(written.behind) // 2]
        types = dict(list(written.types.items())[: len(written.types) // 2])
        written = replace(written, types=types, behind=kept)
        frame = _encoded(written)
    if len(frame) > PROBE_ANSWER_LIMIT:
        raise ValueError(f"a probe's answer of {len(frame)} bytes")
    return frame


def decode_probe_answer(frame: bytes) -> ProbeAnswer:
    """Read a probe's answer. Raises FrameError: it is not one."""
    answer = _decoded(ProbeAnswer, frame, PROBE_ANSWER_LIMIT)
    if len(answer.behind) > BEHIND_LIMIT:
        raise FrameError(f"`behind` is not a list of at most {BEHIND_LIMIT}")
    return answer


def _shortened(one: GatewayView) -> GatewayView:
    return replace(
        one,
        silent_for_s=round(one.silent_for_s, 3),
        rtt_s=None if one.rtt_s is None else round(one.rtt_s, 6),
        detail=as_line(one.detail[:BEHIND_DETAIL_LIMIT]),
    )


def _encoded(value: Probe | ProbeAnswer) -> bytes:
    written = {"v": VERSION, **to_plain(value, omit_defaults=True)}
    return json.dumps(written, separators=(",", ":"), allow_nan=False).encode()


def _decoded(cls: type[T], frame: bytes, limit: int) -> T:
    try:
        raw = read_json(frame, limit)
        check_version(raw.get("v"))
        return from_plain(cls, raw)
    except ValueError as error:
        raise FrameError(str(error)) from error
