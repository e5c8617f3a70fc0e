"""What is said to a connection's requests: a payload or a refusal to each, alone or together.

Owns: how replies become messages. Not here: when they leave (`reply_queue`), whether that may
block (`streams`).
"""

from __future__ import annotations

from collections.abc import Sequence

from fogft.link import batch_frames, frame
from fogft.link.compression import Compression
from fogft.link.credit import SMALL_BYTES
from fogft.link.zenoh.flow_watch import THIN_BYTES_PER_S
from fogft.link.zenoh.replica.reply_streams import Stream


class Reply:
    """One answer: a payload, or a refusal where that is not empty.

    Attributes:
        stream: Whose query it is a reply to.
        may_pack: It may be compressed: its robot's link was seen to be thin.
    """

    __slots__ = ("may_pack", "payload", "refusal", "request_id", "stream")

    def __init__(
        self,
        stream: Stream,
        request_id: bytes,
        payload: bytes,
        refusal: str,
        *,
        may_pack: bool = False,
    ) -> None:
        self.stream = stream
        self.request_id = request_id
        self.payload = payload
        self.refusal = refusal
        self.may_pack = may_pack

    @property
    def joins(self) -> bool:
        """Whether it may leave in one message with others."""
        return len(self.payload) <= batch_frames.ENTRY_BYTES_LIMIT and not self.may_pack

    @property
    def small(self) -> bool:
        """Whether it may leave at once, where the stream lets it."""
        return len(self.payload) <= SMALL_BYTES and not self.may_pack

    def send(self, stamp: bytes) -> None:
        """Send it. Blocks for as long as its robot takes nothing and the way there is full.

        Raises:
            zenoh.ZError: The session is closed.
        """
        query = self.stream.query
        if self.refusal:
            query.reply_err(frame.encode_refusal(stamp, self.request_id, self.refusal))
            return
        packed = Compression().pack(self.payload, THIN_BYTES_PER_S) if self.may_pack else None
        header = frame.encode_answer(stamp, self.request_id, packed=packed is not None)
        payload = self.payload if packed is None else packed
        self.payload = b""
        query.reply(query.key_expr, payload, attachment=header)


def send_together(replies: Sequence[Reply], stamp: bytes) -> None:
    """Send replies of one stream. May block as `Reply.send` does.

    Raises:
        zenoh.ZError: The session is closed.
    """
    if len(replies) == 1:
        replies[0].send(stamp)
        return
    header, content = batch_frames.encode_answers(
        stamp, [(reply.request_id, reply.payload, reply.refusal) for reply in replies]
    )
    query = replies[0].stream.query
    query.reply(query.key_expr, content, attachment=header)
