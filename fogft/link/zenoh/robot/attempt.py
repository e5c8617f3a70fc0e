"""One request on its way through one connection, and how its end is read.

Owns: what a connection keeps of an attempt, the meaning of a reply. Not here: sending
(`attempts`).
"""

from __future__ import annotations

from collections.abc import Sequence

import zenoh

from fogft.errors import FrameError
from fogft.link import batch_frames, frame
from fogft.link.compression import unpack
from fogft.link.port import Answer
from fogft.model.refusal import Refusal


class OpenAttempt:
    """A request on its way through one connection."""

    __slots__ = ("deadline", "mark", "offered", "payload", "request_id", "service", "size")

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


def read_reply(reply: zenoh.Reply) -> tuple[bytes, Sequence[Answer]]:
    """Return a reply's stamp, and what it answers to requests: a payload or a refusal to each.

    Raises:
        FrameError: It does not say to which.
    """
    ok = reply.ok
    if ok is None:
        err = reply.err
        stamp, id, refusal = frame.decode_refusal(b"" if err is None else err.payload.to_bytes())
        return stamp, (Answer(id, None, refusal),)
    attachment = ok.attachment
    if attachment is None:
        raise FrameError("an answer without a header")
    header, payload = attachment.to_bytes(), ok.payload.to_bytes()
    if batch_frames.is_batch(header):
        return batch_frames.decode_answers(header, payload)
    stamp, id, packed = frame.decode_answer(header)
    if packed:
        try:
            payload = unpack(payload)
        except ValueError:
            return stamp, (Answer(id, None, Refusal.MALFORMED),)
    return stamp, (Answer(id, payload),)
