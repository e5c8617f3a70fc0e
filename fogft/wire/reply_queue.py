"""Replies on their way out: a queue and a thread for each connection of a robot.

A reply to a frozen robot blocks until Zenoh gives that robot's session up. So each
connection has its own thread; it ends when it has had nothing to do for a while.

Answers to requests are replies to one query of the connection, which stays open (`streams`). A
probe's query is ended. That sends something too, so it is done by the same thread. And it must not
be done while Zenoh's own thread still holds that query: then the last to let go would be Zenoh's
thread, which would wait for room that only it can make, and with it every link of this process
would stand still. So a query is ended when that thread has come to the next one (`turns`).

Owns: the order and the bounds of replies. Not here: what is replied.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from queue import Empty, SimpleQueue

import zenoh

from fogft.core.repeats import worth_logging
from fogft.wire import batch_frames, frame
from fogft.wire.compression import Compression
from fogft.wire.flow_watch import THIN_BYTES_PER_S
from fogft.wire.port import Refusal

log = logging.getLogger(__name__)

REPLIES_LIMIT = 1024
BYTES_LIMIT = 64 << 20
_IDLE_S = 5.0
_END_LOOK_S = 0.2  # nobody waits for an end
_END_ANYWAY_S = 1.0  # Zenoh's thread has long let go, though nothing came after


class Counters:
    """Counts by event name, from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def add(self, event: str, times: int = 1) -> int:
        """Count an event; return how often it has happened."""
        with self._lock:
            self._counts[event] += times
            return self._counts[event]

    def snapshot(self) -> Mapping[str, int]:
        """Return all counts."""
        with self._lock:
            return dict(self._counts)


class QueryTurns:
    """Which query Zenoh's one thread has in its hands: the last that came."""

    def __init__(self) -> None:
        self._last = 0

    def came(self) -> int:
        """Count a query. Called by Zenoh's thread, first of all."""
        self._last += 1
        return self._last

    def over(self, turn: int) -> bool:
        """Whether Zenoh's thread has let go of a query."""
        return turn < self._last


class Reply:
    """What is sent as a reply to a query: a payload, or a refusal where that is not empty.

    Attributes:
        turn: When its query came, by `QueryTurns`; None where it stays open.
        ends_only: It was replied to elsewhere, and is only to be ended.
    """

    __slots__ = ("ends_only", "may_pack", "payload", "query", "refusal", "request_id", "turn")

    def __init__(
        self,
        query: zenoh.Query,
        request_id: bytes,
        payload: bytes,
        refusal: str,
        *,
        turn: int | None = None,
        may_pack: bool = False,
        ends_only: bool = False,
    ) -> None:
        self.turn = turn
        self.may_pack = may_pack
        self.ends_only = ends_only
        self.query: zenoh.Query | None = query
        self.request_id = request_id
        self.payload = payload
        self.refusal = refusal

    def send(self) -> None:
        """Send it; the query is not ended yet. May block for as long as its robot takes nothing.

        Raises:
            zenoh.ZError: The session is closed.
        """
        query = self.query
        if query is None or self.ends_only:
            return
        if self.refusal:
            query.reply_err(frame.encode_refusal(self.request_id, self.refusal))
            return
        # To a robot that has seen its link to be thin, and said so.
        rate = THIN_BYTES_PER_S if self.may_pack else None
        packed = Compression().pack(self.payload, rate)
        header = frame.encode_answer(self.request_id, packed=packed is not None)
        payload = self.payload if packed is None else packed
        self.payload = b""
        query.reply(query.key_expr, payload, attachment=header)

    @property
    def joins(self) -> bool:
        """Whether it may leave in one message with others: small, and of an open query."""
        small = len(self.payload) <= batch_frames.ENTRY_BYTES_LIMIT
        return small and self.turn is None and not self.may_pack and not self.ends_only

    def end(self) -> None:
        """End the query, or the robot waits for more. May block as `send` does."""
        query, self.query = self.query, None
        if query is not None and self.turn is not None:
            query.drop()  # type: ignore[no-untyped-call]


def send_together(replies: Sequence[Reply]) -> None:
    """Send replies to one query, which stays open. May block as `Reply.send` does.

    Raises:
        zenoh.ZError: The session is closed.
    """
    query = replies[0].query
    if len(replies) == 1 or query is None:
        for reply in replies:
            reply.send()
        return
    header, content = batch_frames.encode_answers(
        [(reply.request_id, reply.payload, reply.refusal) for reply in replies]
    )
    query.reply(query.key_expr, content, attachment=header)


class _Unended:
    """What one thread has sent and not ended."""

    def __init__(self, turns: QueryTurns) -> None:
        self._turns = turns
        self._replies: list[tuple[float, Reply]] = []

    def __bool__(self) -> bool:
        return bool(self._replies)

    def add(self, reply: Reply) -> None:
        """End a query now, or as soon as it may be."""
        if reply.turn is None or self._turns.over(reply.turn):
            reply.end()
        else:
            self._replies.append((time.monotonic(), reply))

    def look(self) -> None:
        """End what may be ended by now."""
        waiting, self._replies = self._replies, []
        for since, reply in waiting:
            over = self._turns.over(reply.turn or 0)
            if over or time.monotonic() - since > _END_ANYWAY_S:
                reply.end()
            else:
                self._replies.append((since, reply))


class ReplyQueue:
    """The replies for one connection of a robot."""

    def __init__(self) -> None:
        self.replies: SimpleQueue[Reply | None] = SimpleQueue()
        self.waiting = 0
        self.waiting_bytes = 0
        self.thread: threading.Thread | None = None
        self._taken: list[Reply | None] = []  # it did not fit to what was taken before

    def next(self, timeout_s: float) -> list[Reply]:
        """Wait for what is to be sent next, together; nothing where all ends.

        Raises:
            Empty: Nothing came.
        """
        first = self._taken.pop() if self._taken else self.replies.get(timeout=timeout_s)
        if first is None:
            return []
        together, size = [first], len(first.payload)
        while first.joins and len(together) < batch_frames.LIMIT:
            try:
                reply = self.replies.get_nowait()
            except Empty:
                break
            size += len(reply.payload) if reply is not None else 0
            fits = size <= batch_frames.BYTES_LIMIT
            if reply is None or not fits or not reply.joins or reply.query is not first.query:
                self._taken.append(reply)
                break
            together.append(reply)
        return together


class ReplyQueues:
    """All reply queues of a listener.

    Args:
        counters: Counts ``replies``, ``refused``, ``reply_dropped`` and ``failed``.
        turns: Tells when a query may be ended.
        idle_s: A thread that had nothing to send for so long ends.
    """

    def __init__(
        self, counters: Counters, turns: QueryTurns | None = None, *, idle_s: float = _IDLE_S
    ) -> None:
        self._counters = counters
        self._turns = turns or QueryTurns()
        self._idle_s = idle_s
        self._lock = threading.Lock()
        self._queues: dict[bytes, ReplyQueue] = {}
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
        elif not reply.ends_only:
            self._counters.add("refused" if reply.refusal else "replies")

    def _begin(self, token: bytes, robot: str) -> ReplyQueue:
        queue = self._queues[token] = ReplyQueue()
        queue.thread = threading.Thread(
            target=self._run, args=(token, queue), name=f"fogft-reply-{robot}", daemon=True
        )
        queue.thread.start()
        return queue

    def _run(self, token: bytes, queue: ReplyQueue) -> None:
        unended = _Unended(self._turns)
        while True:
            try:
                replies = queue.next(_END_LOOK_S if unended else self._idle_s)
            except Empty:
                if unended:
                    self._guarded(unended.look)
                    continue
                with self._lock:
                    if queue.waiting:
                        continue  # one came between the time-out and the lock
                    self._queues.pop(token, None)
                    return
            if not replies:
                return
            size = sum(len(reply.payload) for reply in replies)
            self._guarded(partial(send_together, replies))
            for reply in replies:
                self._guarded(partial(unended.add, reply))
            if unended:
                self._guarded(unended.look)
            with self._lock:
                queue.waiting -= len(replies)
                queue.waiting_bytes -= size
            del reply, replies  # their payloads, while this thread waits

    def _guarded(self, step: Callable[[], None]) -> None:
        try:
            step()
        except Exception as error:
            count = self._counters.add("failed")
            if worth_logging(count):
                log.warning("reply_failed reason=%r count=%d", str(error), count)

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
