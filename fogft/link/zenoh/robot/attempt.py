"""One request on its way through one connection, and what keeps several of them.

Owns: what a connection keeps of an attempt, those that leave together, those still unanswered,
the meaning of a reply. Not here: sending (`attempts`).
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import zenoh

from fogft.errors import FrameError
from fogft.link import batch_frames, frame
from fogft.link.port import Answer
from fogft.model import refusal
from fogft.requests.load import Handling


@dataclass(slots=True, eq=False)
class OpenAttempt:
    """A request on its way through one connection.

    Attributes:
        payload: None once it was sent, or is not wanted.
        size: Bytes of its payload.
        offered: When, and until when it is of use, in monotonic seconds.
        mark: What the connection had sent once this was sent (`credit`).
        reads_packed: The answer may be compressed.
    """

    service: str
    request_id: bytes
    payload: bytes | None
    size: int
    offered: float
    deadline: float
    handling: Handling = Handling.NORMAL
    mark: int = 0
    reads_packed: bool = False


def read_reply(reply: zenoh.Reply) -> tuple[bytes, Sequence[Answer], bool]:
    """Return a reply's stamp, what it answers to each request, and whether the payload is packed.

    Raises:
        FrameError: It does not say to which.
    """
    ok = reply.ok
    if ok is None:
        err = reply.err
        content = b"" if err is None else err.payload.to_bytes()
        stamp, id, said, load = frame.decode_refusal(content)
        kind, detail = refusal.read(said)
        return stamp, (Answer(id, refusal=kind, detail=detail, load=load),), False
    attachment = ok.attachment
    if attachment is None:
        raise FrameError("an answer without a header")
    header, payload = attachment.to_bytes(), ok.payload.to_bytes()
    if batch_frames.is_batch(header):
        return *batch_frames.decode_answers(header, payload), False
    stamp, id, load, packed = frame.decode_answer(header)
    return stamp, (Answer(id, payload, load=load),), packed


LIMIT = 8192  # the window holds 512; a replica that never answers what was forgotten holds no more


class Unanswered:
    """The requests sent on one connection and not answered yet, by id.

    Args:
        limit: Beyond it the oldest are forgotten.
    """

    def __init__(self, limit: int = LIMIT) -> None:
        self._limit = limit
        self._attempts: dict[bytes, OpenAttempt] = {}
        self._lock = threading.Lock()
        self._sent = 0
        self._answered = 0  # counted by one thread, Zenoh's

    @property
    def owed(self) -> int:
        """How many more requests were sent than answers came, those to unknown ids included."""
        return self._sent - self._answered

    def __len__(self) -> int:
        return len(self._attempts)

    def add(self, attempt: OpenAttempt) -> None:
        """Note an attempt that is about to be sent; it takes the place of one of its request."""
        with self._lock:
            self._sent += 1
        self._attempts[attempt.request_id] = attempt
        if len(self._attempts) > self._limit:
            for id in list(self._attempts)[: self._limit // 8]:
                self._attempts.pop(id, None)

    def answered(self, request_id: bytes) -> OpenAttempt | None:
        """Return whom an answer is for, once; None if nobody awaits it."""
        self._answered += 1
        return self._attempts.pop(request_id, None)


class BatchBuffer:
    """Small attempts of one service that wait to leave in one message. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._attempts: list[OpenAttempt] = []
        self._bytes = 0

    def __bool__(self) -> bool:
        return bool(self._attempts)

    def add(self, attempt: OpenAttempt) -> list[OpenAttempt]:
        """Hold a small attempt; return those that leave now because it does not fit to them."""
        with self._lock:
            full = (
                len(self._attempts) >= batch_frames.LIMIT
                or self._bytes + attempt.size > batch_frames.BYTES_LIMIT
                or (self._attempts and self._attempts[0].service != attempt.service)
            )
            leaving = self._take() if full else []
            self._attempts.append(attempt)
            self._bytes += attempt.size
            return leaving

    def take(self) -> list[OpenAttempt]:
        """Return all that is held, in order."""
        if not self._attempts:  # the usual case, without the lock
            return []
        with self._lock:
            return self._take()

    def _take(self) -> list[OpenAttempt]:
        taken, self._attempts, self._bytes = self._attempts, [], 0
        return taken
