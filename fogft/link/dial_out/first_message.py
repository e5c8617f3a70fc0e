"""The first message of a party that has just connected: whole in time, or not at all.

Owns: the time that is left for it. Not here: what it says (`record_frames`).
"""

from __future__ import annotations

import socket
import time
from typing import Any

from fogft.records import frames

_LEAST_S = 0.01  # a time-out of 0 would mean none


def receive(link: socket.socket, limit_bytes: int, within_s: float) -> dict[str, Any]:
    """Return it, however its bytes come; who sends them one by one has no longer than others.

    Args:
        link: The connection. It is left with what remains of the time as its time-out.
        limit_bytes: The longest that it may be.
        within_s: How long it may take, in seconds.

    Raises:
        OSError: It did not come in time, or the connection broke.
        EOFError: The other party left before.
        RecordError: It is none.
    """
    until = time.monotonic() + within_s
    unframer = frames.Unframer(limit=limit_bytes)
    while True:
        left_s = until - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("its first message did not come in time")
        link.settimeout(max(_LEAST_S, left_s))
        data = link.recv(4096)
        if not data:
            raise EOFError("it left without a word")
        for message in unframer.feed(data):
            return message
