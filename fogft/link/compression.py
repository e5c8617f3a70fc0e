"""Compress payloads on slow links if that saves time, and decompress them. No Zenoh.

Uses zlib at its lowest level: on links where compression can pay, zlib is not the bottleneck.
The gain is measured per service. Payloads that do not shrink are sent as is, and rarely retried.

A few kilobytes may decompress to 64 MiB. Zenoh's thread, which receives for all links, must not
spend that time, and no peer may wait behind another, so each peer has a decompression thread.
"""

import contextlib
import logging
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable

from fogft.process import on_thread

log = logging.getLogger(__name__)

# A replica reads zlib, and compresses answers on its own: robots of 0.2.0 look for these words.
ACCEPTED = frozenset({"zlib", "zlib-answers"})
LEAST_BYTES = 2048  # smaller ones fit into one or two packets
ASIDE_BYTES = 1 << 20  # larger ones take long to check, so they too are kept off Zenoh's thread
LIMIT_BYTES = 64 << 20  # payloads that decompress to more are refused
FASTEST_BYTES_PER_S = 30e6  # faster links gain nothing from zlib
_SAMPLE_BYTES = 32 << 10
_GAIN = 0.9  # compress if at most this share of the sending time remains
_LEVEL = 1
_FIRST_PAUSE, _LONGEST_PAUSE = 16, 1024
_SHARE_OF_NEW = 0.3


class Compression:
    """Compresses one service's payloads on one connection; tracks their `ratio`. One thread."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self.ratio: float | None = None
        self._s_per_byte = 0.0
        self._rest = 0  # payloads to skip before the next trial
        self._pause = _FIRST_PAUSE

    def pack(self, payload: bytes, bytes_per_s: float | None) -> bytes | None:
        """Return the compressed payload; None to send it uncompressed.

        `bytes_per_s` is the measured rate of the link; None if unknown, which counts as fast.
        """
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
        return packed if len(packed) < len(payload) * _GAIN else None

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
        s_per_byte = 1 / max(bytes_per_s, 1.0)  # it may have been measured while stalled
        return self._s_per_byte + self.ratio * s_per_byte < _GAIN * s_per_byte


def unpack(packed: bytes, limit: int = LIMIT_BYTES) -> bytes:
    """Decompress a payload. Raises ValueError: invalid, incomplete, or above `limit` bytes."""
    reader = zlib.decompressobj()
    try:
        payload = reader.decompress(packed, limit)
    except zlib.error as error:
        raise ValueError(f"a payload that cannot be decompressed: {error}") from error
    if not reader.eof or reader.unused_data or reader.unconsumed_tail:
        raise ValueError(f"a compressed payload that is cut short, or above {limit} bytes")
    return payload


WAITING_LIMIT = 64  # payloads queued per peer
WAITING_BYTES_LIMIT = 64 << 20  # their total, compressed

Done = Callable[[bytes | None], None]  # takes the payload; None if it cannot be decompressed


class Unpacker:
    """Decompresses payloads on one thread per peer. Callable from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: dict[str, deque[tuple[bytes, Done, bool]]] = {}

    def put(self, peer: str, content: bytes, done: Done, *, packed: bool = True) -> bool:
        """Queue a payload: the peer's thread decompresses it, if `packed`, and calls `done`.

        False if too much of this peer is queued, or no thread can be started.
        """
        with self._lock:
            waiting = self._waiting.get(peer)
            if waiting is not None:
                held = sum(len(one) for one, *_ in waiting)
                if len(waiting) >= WAITING_LIMIT or held + len(content) > WAITING_BYTES_LIMIT:
                    return False
                waiting.append((content, done, packed))
                return True
            try:
                on_thread(self._run, peer, name=f"fogft-unpack-{peer}")
            except OSError:
                return False
            self._waiting[peer] = deque(((content, done, packed),))
        return True

    def _run(self, peer: str) -> None:
        while True:
            with self._lock:
                if not self._waiting[peer]:
                    del self._waiting[peer]
                    return
                content, done, packed = self._waiting[peer].popleft()
            payload: bytes | None = None
            with contextlib.suppress(ValueError):  # `done` counts the failure, and logs some
                payload = unpack(content) if packed else content
            try:
                done(payload)
            except Exception:  # continue with the next ones
                log.exception("payload_not_taken peer=%s", peer)
            del content, payload, done  # while this thread waits for the lock, and after
