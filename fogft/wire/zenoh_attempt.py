"""One request on its way through one connection, and how its end is read.

Owns: what a connection keeps of an attempt, the meaning of a reply. Not here: sending
(`zenoh_connection`).
"""

from __future__ import annotations

import zenoh

from fogft.wire import frame
from fogft.wire.compression import unpack
from fogft.wire.port import Answer, Refusal


class OpenAttempt:
    """A request on its way through one connection."""

    __slots__ = (*("deadline", "mark", "offered", "payload", "request_id", "service", "size"),)

    def __init__(
        self,
        service: str,
        request_id: bytes,
        payload: bytes,
        *,
        offered: float,
        remaining_s: float,
    ) -> None:
        self.service = service
        self.request_id = request_id
        self.payload: bytes | None = payload  # None once it was sent, or is not wanted
        self.size = len(payload)
        self.offered = offered
        self.deadline = offered + remaining_s
        self.mark = 0  # what the connection had sent once this was sent (`credit`)


def read_reply(reply: zenoh.Reply) -> Answer:
    """Return what a replica answers to a request: a payload or a refusal.

    Raises:
        FrameError: It does not say to which.
    """
    if reply.err is not None:
        id, refusal = frame.decode_refusal(reply.err.payload.to_bytes())
        return Answer(id, None, refusal)
    if reply.ok is None or reply.ok.attachment is None:
        raise frame.FrameError("an answer without a header")
    id, packed = frame.decode_answer(reply.ok.attachment.to_bytes())
    payload = reply.ok.payload.to_bytes()
    if packed:
        try:
            payload = unpack(payload)
        except ValueError:
            return Answer(id, None, Refusal.MALFORMED)
    return Answer(id, payload)
