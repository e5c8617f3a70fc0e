"""A request that came over Zenoh, until it is answered: once, or refused where it is forgotten.

Owns: that there is one answer. Not here: when it leaves (`reply_queue`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from fogft.link import frame
from fogft.link.zenoh.replica.reply_queue import Reply, ReplyQueues
from fogft.link.zenoh.replica.reply_streams import Stream
from fogft.link.zenoh.work_queue import WorkQueue
from fogft.model.refusal import Refusal
from fogft.requests.load import Load


class ZenohIncoming:
    """A request that came over Zenoh; see `port.Incoming`."""

    __slots__ = (
        *("_header", "_queues", "_streams", "_thin", "_work_queue"),
        *("handling", "payload", "remaining_s", "request_id", "robot", "service"),
    )

    def __init__(
        self,
        service: str,
        header: frame.RequestHeader,
        payload: bytes,
        *,
        stream: Stream,
        queues: ReplyQueues,
        work: WorkQueue,
        thin: Callable[[bytes], bool],
    ) -> None:
        self._thin = thin
        self._header = header
        self.service = service
        self.payload = payload
        self.request_id = header.request_id
        self.robot = header.robot
        self.remaining_s = header.remaining_s
        self.handling = header.handling
        self._streams = [stream]  # taken by the first answer; list.pop is atomic
        self._queues = queues
        self._work_queue = work

    def reply(self, payload: bytes, *, load: Load | None = None, more: bool = False) -> None:
        """Send the serialised response. Never blocks. With `more`, others will soon follow."""
        self._send(payload, "", load, more=more)

    def refuse(self, reason: Refusal, detail: str = "", *, load: Load | None = None) -> None:
        """Send a refusal. Never blocks."""
        self._send(b"", reason.text(detail), load, more=True)

    def _send(self, payload: bytes, refusal: str, load: Load | None, *, more: bool) -> None:
        try:
            stream = self._streams.pop()
        except IndexError:
            return  # answered before
        self.payload = b""
        header = self._header
        packs = header.may_pack or (header.reads_packed and self._thin(header.token))
        said = frame.encode_load(load)
        reply = Reply(stream, header.request_id, payload, refusal, said, may_pack=packs)
        self._queues.put(header.token, header.robot, reply, more=more)

    def __del__(self) -> None:
        """Refuse what its owner forgot: the robot must not wait for it until its deadline.

        The collector may call this anywhere, even while a lock of ours is held; a
        `SimpleQueue` may be put into from here.
        """
        if self._streams:
            forgotten = Reply(self._streams.pop(), self._header.request_id, b"", Refusal.LOST)
            header = self._header
            refuse = partial(self._queues.put, header.token, header.robot, forgotten, more=True)
            self._work_queue.add(refuse)
