"""One request on its way through one connection, and how its end is read.

Owns: what a connection keeps of an attempt, the meaning of a reply. Not here: sending
(`zenoh_connection`).
"""

from __future__ import annotations

import zenoh

from fogft.wire import frame
from fogft.wire.compression import unpack
from fogft.wire.port import Refusal


class OpenAttempt:
    """A request on its way through one connection."""

    __slots__ = (
        *("deadline", "key", "mark", "offered", "payload", "request_id", "service", "size"),
    )

    def __init__(
        self,
        service: str,
        key: zenoh.KeyExpr,
        request_id: bytes,
        payload: bytes,
        *,
        offered: float,
        remaining_s: float,
    ) -> None:
        self.service = service
        self.key = key
        self.request_id = request_id
        self.payload: bytes | None = payload  # None once it was sent, or is not wanted
        self.size = len(payload)
        self.offered = offered
        self.deadline = offered + remaining_s
        self.mark = 0  # what the connection had sent once this was sent (`credit`)


def ran_in_vain(reply: zenoh.Reply) -> bool:
    """Whether the replica says that it ran a request whose answer was not wanted any more."""
    if reply.err is None:
        return False
    try:
        return frame.decode_refusal(reply.err.payload.to_bytes())[1] == Refusal.LATE
    except frame.FrameError:
        return False


def read_reply(reply: zenoh.Reply, request_id: bytes) -> tuple[bytes | None, str]:
    """Return payload and refusal of a reply: one of both.

    Raises:
        FrameError: It is an answer to another request, or none at all.
    """
    payload, refusal = None, ""
    if reply.ok is not None:
        if reply.ok.attachment is None:
            raise frame.FrameError("an answer without a header")
        answered_id, packed = frame.decode_answer(reply.ok.attachment.to_bytes())
        payload = reply.ok.payload.to_bytes()
        if packed:
            payload = _unpacked(payload)
    elif reply.err is not None:
        content = reply.err.payload.to_bytes()
        if content == b"Timeout":  # Zenoh's own, in place of an answer
            return None, Refusal.LOST
        answered_id, refusal = frame.decode_refusal(content)
    else:
        raise frame.FrameError("neither an answer nor a refusal")
    if answered_id != request_id:
        raise frame.FrameError("an answer to another request")
    return payload, refusal


def _unpacked(payload: bytes) -> bytes:
    try:
        return unpack(payload)
    except ValueError as error:
        raise frame.FrameError(str(error)) from error
