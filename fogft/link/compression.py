"""Compress what a thin uplink carries, where it pays. No clock of its own, no Zenoh.

zlib at its lowest level: it is in every Python, and on the links where compression can pay at
all it is not what limits. What pays is measured for each service: how far its bytes shrink and
how long that takes, against how long they would take to leave at the rate that was seen. What
does not shrink is left alone, and tried again rarely.

Owns: when and how. Not here: rates (`socket_progress`), headers (`frame`).
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable

# What a replica reads, and finds out by itself for answers: robots of 0.2.0 ask for these words.
ACCEPTED = frozenset({"zlib", "zlib-answers"})
LEAST_BYTES = 2048  # smaller ones leave in one packet or two
LIMIT_BYTES = 64 << 20  # more than a window holds: a frame that claims more is refused
FASTEST_BYTES_PER_S = 30e6  # a link that drains faster gains nothing by zlib
_SAMPLE_BYTES = 32 << 10
_GAIN = 0.9  # of the time to leave, at most so much may remain
_LEVEL = 1
_FIRST_PAUSE, _LONGEST_PAUSE = 16, 1024
_SHARE_OF_NEW = 0.3


class Compression:
    """Compresses the payloads of one service on one connection, by its last `ratio`. One thread."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self.ratio: float | None = None
        self._s_per_byte = 0.0
        self._rest = 0  # so many are left alone before the next trial
        self._pause = _FIRST_PAUSE

    def pack(self, payload: bytes, bytes_per_s: float | None) -> bytes | None:
        """Return the payload compressed; None where it is to be sent as it is."""
        if bytes_per_s is None or bytes_per_s > FASTEST_BYTES_PER_S:
            return None
        if not LEAST_BYTES <= len(payload) <= LIMIT_BYTES:
            return None
        if self._rest:
            self._rest -= 1
            return None
        if self.ratio is None or not self._pays(bytes_per_s):
            self._compress(payload[:_SAMPLE_BYTES])
            if not self._pays(bytes_per_s):
                self._rest, self._pause = self._pause, min(2 * self._pause, _LONGEST_PAUSE)
                return None
        packed = self._compress(payload)
        self._pause = _FIRST_PAUSE
        if len(packed) >= len(payload) * _GAIN:
            return None
        return packed

    def _compress(self, payload: bytes) -> bytes:
        began = self._clock()
        packed = zlib.compress(payload, _LEVEL)
        took_s = self._clock() - began
        ratio, s_per_byte = len(packed) / len(payload), took_s / len(payload)
        if self.ratio is None:
            self.ratio, self._s_per_byte = ratio, s_per_byte
        else:
            self.ratio += _SHARE_OF_NEW * (ratio - self.ratio)
            self._s_per_byte += _SHARE_OF_NEW * (s_per_byte - self._s_per_byte)
        return packed

    def _pays(self, bytes_per_s: float) -> bool:
        assert self.ratio is not None
        s_per_byte = 1 / max(bytes_per_s, 1.0)  # it may have stood still when it was seen
        return self._s_per_byte + self.ratio * s_per_byte < _GAIN * s_per_byte


def unpack(packed: bytes, limit: int = LIMIT_BYTES) -> bytes:
    """Return what was compressed. Raises ValueError: it is not whole, or above `limit` bytes."""
    reader = zlib.decompressobj()
    try:
        payload = reader.decompress(packed, limit)
    except zlib.error as error:
        raise ValueError(f"a payload that cannot be decompressed: {error}") from error
    if not reader.eof or reader.unused_data or reader.unconsumed_tail:
        raise ValueError(f"a compressed payload that is cut short, or above {limit} bytes")
    return payload
