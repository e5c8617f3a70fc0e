"""Requests received over Zenoh until they are answered, and the queues of their replies.

A request is answered once, or refused if its owner forgets it. A reply to a frozen robot blocks
until Zenoh gives up that robot's session, so each connection has its own queue and thread. Replies
that cannot block (`reply_streams`) are sent at once by the calling thread, unless it is Zenoh's.
Queries to end go through the same queues. Methods that send raise `zenoh.ZError` if the session is
closed.
"""

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import partial
from queue import Empty, SimpleQueue
from threading import get_ident

from fogft.byte_limit import SMALL_BYTES, ByteLimit
from fogft.counters import Counters
from fogft.link import batch_frames, frame
from fogft.link.compression import Compression
from fogft.link.zenoh import threads
from fogft.link.zenoh.flow_watch import THIN_BYTES_PER_S
from fogft.link.zenoh.replica.query_ends import QueryEnd
from fogft.link.zenoh.replica.reply_streams import Stream
from fogft.link.zenoh.settings import MESSAGE_BYTES_LIMIT
from fogft.model.refusal import Refusal
from fogft.process import on_thread
from fogft.requests.load import Load

log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class Reply:
    """One reply: a refusal if `refusal` is not empty, else a payload."""

    stream: Stream
    request_id: bytes
    payload: bytes
    refusal: str
    load: bytes = frame.NO_LOAD  # the replica's load
    may_pack: bool = False  # it may be compressed: its robot's link was measured to be slow

    @property
    def joins(self) -> bool:
        """Whether it may be batched with others."""
        return len(self.payload) <= batch_frames.ENTRY_BYTES_LIMIT and not self.may_pack

    def send(self, stamp: bytes) -> None:
        """Send it. Blocks while the robot does not read and the connection is full."""
        query = self.stream.query
        if self.refusal:
            query.reply_err(frame.encode_refusal(stamp, self.request_id, self.refusal, self.load))
            return
        packed = Compression().pack(self.payload, THIN_BYTES_PER_S) if self.may_pack else None
        header = frame.encode_answer(
            stamp, self.request_id, load=self.load, packed=packed is not None
        )
        payload = self.payload if packed is None else packed
        self.payload = b""
        query.reply(query.key_expr, payload, attachment=header)


def send_together(replies: Sequence[Reply], stamp: bytes) -> None:
    """Send replies of one stream. May block like `Reply.send`."""
    if len(replies) == 1:
        replies[0].send(stamp)
        return
    header, content = batch_frames.encode_answers(
        stamp, [(reply.request_id, reply.load, reply.payload, reply.refusal) for reply in replies]
    )
    query = replies[0].stream.query
    query.reply(query.key_expr, content, attachment=header)


REPLIES_LIMIT = 1024
_HEAD_BYTES = 4096
_REFUSALS_LIMIT = 4 * REPLIES_LIMIT  # including those that replace dropped replies
BYTES_LIMIT = 64 << 20
_END_LOOK_S = 1.0  # nobody waits for a query to end


class ReplyQueue:
    """The queued replies for one connection of a robot."""

    def __init__(self) -> None:
        self.replies: SimpleQueue[Reply | QueryEnd | None] = SimpleQueue()
        self.waiting = 0
        self.large = ByteLimit(BYTES_LIMIT)  # of the waiting ones
        self.thread: threading.Thread  # started before the queue is used
        self._taken: list[Reply | QueryEnd | None] = []  # one that did not fit into the last batch

    def next(self, timeout_s: float) -> list[Reply] | QueryEnd:
        """Wait for replies to send together, or a query to end; [] once closed. Raises Empty."""
        first = self._taken.pop() if self._taken else self.replies.get(timeout=timeout_s)
        if first is None:
            return []
        if isinstance(first, QueryEnd):
            return first
        together, size = [first], len(first.payload)
        joins = first.joins
        while joins and len(together) < batch_frames.LIMIT:
            try:
                reply = self.replies.get_nowait()
            except Empty:
                break
            if isinstance(reply, Reply) and reply.joins and reply.stream is first.stream:
                size += len(reply.payload)
                if size <= batch_frames.BYTES_LIMIT:
                    together.append(reply)
                    continue
            self._taken.append(reply)
            break
        return together


@dataclass(eq=False)
class ReplyQueues:
    """All reply queues of a listener.

    `later` runs a job on a thread that may block; the garbage collector calls it.
    """

    idle_s = 5.0  # a thread with nothing to send for this long ends

    counters: Counters
    _: KW_ONLY
    later: Callable[[Callable[[], None]], None] = lambda job: job()

    def __post_init__(self) -> None:
        self.refusals = Counters()
        self._lock = threading.Lock()
        self._queues: dict[bytes, ReplyQueue] = {}
        self._closed = False

    def __len__(self) -> int:
        return len(self._queues)

    def put(self, token: bytes, robot: str, reply: Reply, *, more: bool) -> None:
        """Send or queue a reply. Never blocks; if the queue is full, the reply is dropped."""
        size, counted = len(reply.payload), "refused" if reply.refusal else "replies"
        small = size <= SMALL_BYTES and not reply.may_pack
        if small and not more and not self._closed and get_ident() not in threads.idents:
            try:
                sent = reply.stream.send_at_once(reply.send)
            except Exception as error:
                self._failed(error)
                sent = True
            if sent:
                self.counters.add(counted)
                return
        with self._lock:
            queue = None if self._closed else self._queue(token, robot)
            if queue is None or queue.waiting >= _REFUSALS_LIMIT:
                return
            too_large = size > MESSAGE_BYTES_LIMIT - _HEAD_BYTES
            dropped = queue.waiting >= REPLIES_LIMIT or not queue.large.has_room(size) or too_large
            if dropped:
                refusal = Refusal.MALFORMED.text("too large") if too_large else Refusal.LOST
                reply.payload, reply.refusal, size = b"", refusal, 0
            queue.waiting += 1
            if size > SMALL_BYTES:
                queue.large.add(size)
            queue.replies.put(reply)
        self.counters.add("reply_dropped" if dropped else counted)

    def end(self, token: bytes, robot: str, query: QueryEnd) -> None:
        """Queue a query to be ended. Never blocks."""
        with self._lock:
            if self._closed:
                return
            queue = self._queue(token, robot)
            queue.waiting += 1
            queue.replies.put(query)
        if query.refusal:
            self.counters.add("refused")

    def _queue(self, token: bytes, robot: str) -> ReplyQueue:
        queue = self._queues.get(token)
        if queue is not None:
            return queue
        queue = ReplyQueue()
        # If that fails, the next reply tries again.
        queue.thread = on_thread(self._run, token, queue, name=f"fogft-reply-{robot}")
        self._queues[token] = queue
        return queue

    def _run(self, token: bytes, queue: ReplyQueue) -> None:
        unended: list[QueryEnd] = []
        while True:
            if unended:
                unended = [one for one in unended if not self._guarded(one.ended)]
            try:
                taken = queue.next(_END_LOOK_S if unended else self.idle_s)
            except Empty:
                with self._lock:
                    if unended or queue.waiting:
                        continue  # one came between the time-out and the lock
                    self._queues.pop(token, None)
                    return
            if isinstance(taken, QueryEnd):
                self._guarded(taken.say)
                unended.append(taken)
                sizes = [0]
            elif taken:
                sizes = [len(reply.payload) for reply in taken]
                self._guarded(partial(taken[0].stream.send, partial(send_together, taken)))
            else:
                return
            with self._lock:
                queue.waiting -= len(sizes)
                for size in sizes:
                    if size > SMALL_BYTES:
                        queue.large.remove(size)
            del taken  # its payloads, while this thread waits

    def _guarded(self, step: Callable[[], object]) -> object:
        try:
            return step()
        except Exception as error:
            self._failed(error)
            return True

    def _failed(self, error: Exception) -> None:
        self.counters.warn(log, "failed", "reply_failed reason=%r", str(error))

    def close(self, timeout_s: float) -> None:
        """Stop accepting replies; wait briefly for queued ones."""
        with self._lock:
            self._closed = True
            queues = list(self._queues.values())
            self._queues.clear()
        for queue in queues:
            queue.replies.put(None)
        for queue in queues:
            queue.thread.join(timeout_s / max(len(queues), 1))


class ZenohIncoming:
    """A request received over Zenoh; see `port.Incoming`."""

    __slots__ = (
        *("_header", "_queues", "_streams"),
        *("handling", "payload", "remaining_s", "request_id", "robot", "service"),
    )

    def __init__(
        self,
        service: str,
        header: frame.RequestHeader,
        payload: bytes,
        stream: Stream,
        queues: ReplyQueues,
    ) -> None:
        self._header = header
        self.service = service
        self.payload = payload
        self.request_id = header.request_id
        self.robot = header.robot
        self.remaining_s = header.remaining_s
        self.handling = header.handling
        self._streams = [stream]  # taken by the first answer; list.pop is atomic
        self._queues = queues

    def reply(self, payload: bytes, *, load: Load | None = None, more: bool = False) -> None:
        """Send the serialised response. Never blocks. With `more`, other replies follow soon."""
        self._send(payload, "", load, more=more)

    def refuse(self, reason: Refusal, detail: str = "", *, load: Load | None = None) -> None:
        """Send a refusal. Never blocks."""
        if self._streams:
            self._queues.refusals.add(reason.value)
        self._send(b"", reason.text(detail), load, more=True)

    def _send(self, payload: bytes, refusal: str, load: Load | None, *, more: bool) -> None:
        try:
            stream = self._streams.pop()
        except IndexError:
            return  # answered before
        self.payload = b""
        header = self._header
        slow = stream.slow()
        packs = header.may_pack or (header.reads_packed and slow)
        said = frame.encode_load(load)
        reply = Reply(stream, header.request_id, payload, refusal, said, may_pack=packs)
        self._queues.put(header.token, header.robot, reply, more=more or slow)

    def __del__(self) -> None:
        """Refuse a forgotten request, via a `SimpleQueue`: one of our locks may be held now."""
        if self._streams:
            forgotten = Reply(self._streams.pop(), self._header.request_id, b"", Refusal.LOST)
            header = self._header
            refuse = partial(self._queues.put, header.token, header.robot, forgotten, more=True)
            self._queues.later(refuse)
