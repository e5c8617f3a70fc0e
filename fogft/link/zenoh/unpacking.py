"""Decompress what came over a link, in a thread of the peer's own.

A few kilobytes may become 64 MiB. Zenoh's thread, which brings the bytes of all links, must not
spend that time; and nobody waits behind what another peer sent. A thread begins with the first
payload of a peer and ends with its last.

Owns: those threads, and what waits for them. Not here: the bytes (`compression`), whether a payload
may be packed at all (`attempts`, `listener`).
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import deque
from collections.abc import Callable

from fogft.link.compression import unpack

log = logging.getLogger(__name__)

WAITING_LIMIT = 64  # payloads of one peer
WAITING_BYTES_LIMIT = 64 << 20  # of them together, packed

Done = Callable[[bytes | None], None]  # takes the payload; None where it cannot be decompressed


class Unpacker:
    """Decompresses the payloads of several peers. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: dict[str, deque[tuple[bytes, Done]]] = {}

    def put(self, peer: str, packed: bytes, done: Done) -> bool:
        """Decompress a payload, then call `done`; False where too much of this peer waits."""
        with self._lock:
            waiting = self._waiting.get(peer)
            if waiting is not None:
                held = sum(len(one) for one, _ in waiting)
                if len(waiting) >= WAITING_LIMIT or held + len(packed) > WAITING_BYTES_LIMIT:
                    return False
                waiting.append((packed, done))
                return True
            self._waiting[peer] = deque(((packed, done),))
        threading.Thread(
            target=self._run, args=(peer,), name=f"fogft-unpack-{peer}", daemon=True
        ).start()
        return True

    def _run(self, peer: str) -> None:
        while True:
            with self._lock:
                if not self._waiting[peer]:
                    del self._waiting[peer]
                    return
                packed, done = self._waiting[peer].popleft()
            payload: bytes | None = None
            with contextlib.suppress(ValueError):  # whose payload it was counts it, and logs some
                payload = unpack(packed)
            try:
                done(payload)
            except Exception:  # the next ones go on
                log.exception("payload_not_taken peer=%s", peer)
            del packed, payload, done  # while this thread waits for the lock, and after
