"""Replies on their way out: a queue and a thread for each connection of a robot.

A reply to a frozen robot blocks until Zenoh gives that robot's session up. So each
connection has its own thread; it ends when it has had nothing to do for a while.

Owns: the order and the bounds of replies. Not here: what is replied.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Mapping
from queue import Empty, SimpleQueue

import zenoh

from fogft.wire import frame
from fogft.wire.compression import Compression
from fogft.wire.flow_watch import THIN_BYTES_PER_S
from fogft.wire.port import Refusal

log = logging.getLogger(__name__)

REPLIES_LIMIT = 1024
BYTES_LIMIT = 64 << 20
_IDLE_S = 5.0


class Counters:
    """Counts by event name, from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def add(self, event: str) -> int:
        """Count an event; return how often it has happened."""
        with self._lock:
            self._counts[event] += 1
            return self._counts[event]

    def snapshot(self) -> Mapping[str, int]:
        """Return all counts."""
        with self._lock:
            return dict(self._counts)


class Reply:
    """What one query gets: a payload, or a refusal where that is not empty."""

    __slots__ = ("may_pack", "payload", "query", "refusal", "request_id")

    def __init__(
        self,
        query: zenoh.Query,
        request_id: bytes,
        payload: bytes,
        refusal: str,
        *,
        may_pack: bool = False,
    ) -> None:
        self.may_pack = may_pack
        self.query: zenoh.Query | None = query
        self.request_id = request_id
        self.payload = payload
        self.refusal = refusal

    def send(self) -> None:
        """Send it. May block for as long as `wait_before_close`.

        Raises:
            zenoh.ZError: The session is closed.
        """
        query, self.query = self.query, None
        if query is None:
            return
        try:
            if self.refusal:
                query.reply_err(frame.encode_refusal(self.request_id, self.refusal))
            else:
                # To a robot that has seen its link to be thin, and said so.
                rate = THIN_BYTES_PER_S if self.may_pack else None
                packed = Compression().pack(self.payload, rate)
                header = frame.encode_answer(self.request_id, packed=packed is not None)
                payload = self.payload if packed is None else packed
                query.reply(query.key_expr, payload, attachment=header)
        finally:
            query.drop()  # type: ignore[no-untyped-call]  # or the robot waits for more


class _Queue:
    """The replies for one connection of a robot."""

    def __init__(self) -> None:
        self.replies: SimpleQueue[Reply | None] = SimpleQueue()
        self.waiting = 0
        self.waiting_bytes = 0
        self.thread: threading.Thread | None = None


class ReplyQueues:
    """All reply queues of a listener.

    Args:
        counters: Counts ``replies``, ``refused``, ``reply_dropped`` and ``failed``.
        idle_s: A thread that had nothing to send for so long ends.
    """

    def __init__(self, counters: Counters, *, idle_s: float = _IDLE_S) -> None:
        self._counters = counters
        self._idle_s = idle_s
        self._lock = threading.Lock()
        self._queues: dict[bytes, _Queue] = {}
        self._closed = False

    def __len__(self) -> int:
        return len(self._queues)

    def put(self, token: bytes, robot: str, reply: Reply) -> None:
        """Queue a reply. Never blocks; where too much waits, the robot gets none.

        Args:
            token: The robot's connection: replies of one never wait for another's.
            robot: Its name, for people.
            reply: What to send.
        """
        size = len(reply.payload)
        with self._lock:
            if self._closed:
                return
            queue = self._queues.get(token)
            if queue is None:
                queue = self._begin(token, robot)
            full = queue.waiting >= REPLIES_LIMIT or queue.waiting_bytes + size > BYTES_LIMIT
            dropped = full and queue.waiting > 0
            if dropped:
                reply.payload, reply.refusal, size = b"", Refusal.LOST, 0
            queue.waiting += 1
            queue.waiting_bytes += size
            queue.replies.put(reply)
        if dropped:
            self._counters.add("reply_dropped")
        else:
            self._counters.add("refused" if reply.refusal else "replies")

    def _begin(self, token: bytes, robot: str) -> _Queue:
        queue = self._queues[token] = _Queue()
        queue.thread = threading.Thread(
            target=self._run, args=(token, queue), name=f"fogft-reply-{robot}", daemon=True
        )
        queue.thread.start()
        return queue

    def _run(self, token: bytes, queue: _Queue) -> None:
        while True:
            try:
                reply = queue.replies.get(timeout=self._idle_s)
            except Empty:
                with self._lock:
                    if queue.waiting:
                        continue  # one came between the time-out and the lock
                    self._queues.pop(token, None)
                    return
            if reply is None:
                return
            size = len(reply.payload)
            try:
                reply.send()
            except Exception as error:
                count = self._counters.add("failed")
                if count & (count - 1) == 0:
                    log.warning("reply_failed reason=%r count=%d", str(error), count)
            with self._lock:
                queue.waiting -= 1
                queue.waiting_bytes -= size
            del reply  # its payload, while this thread waits

    def close(self, timeout_s: float) -> None:
        """Take nothing more; wait a moment for what is queued."""
        with self._lock:
            self._closed = True
            queues = list(self._queues.values())
            self._queues.clear()
        for queue in queues:
            queue.replies.put(None)
        for queue in queues:
            if queue.thread is not None:
                queue.thread.join(timeout_s / max(len(queues), 1))
