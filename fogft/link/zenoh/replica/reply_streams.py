"""The query that carries each connection's replies, and its unacknowledged bytes.

Replying blocks only if the robot reads nothing and all buffers on the path are full. So a thread
that must not block may still reply while the bytes in flight surely fit into those buffers.
Stamps acknowledge replies: each reply carries a random one, and the robot's requests repeat the
last that it has seen, so no robot can make others wait by a false acknowledgement.

All connections of a robot share one credit, as they may share one socket. Replies on another
connection count for a minute after they were sent, since that connection may be gone.

If a token is used for a second query, or its connection is the oldest of too many, its former
query is ended, and the robot opens another connection.
"""

import math
import os
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import NamedTuple
from weakref import WeakValueDictionary

import zenoh

from fogft.link.frame import STAMP_BYTES

CREDIT_LIMIT = 4  # replies of 16 KiB: 64 KiB, which those buffers hold
_OTHERS_COUNT_FOR_S = 60.0

Send = Callable[[bytes], None]  # takes the stamp


class _Sent(NamedTuple):
    connection: object
    at: float  # when sending ended
    may_block: bool  # it was sent by a thread that may block


class ReplyCredit:
    """The replies that one robot has not acknowledged. Any thread."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._gate = threading.Lock()  # held while sending at once, which is short
        self._lock = threading.Lock()
        self._blockable = 0  # sends in progress that may block
        self._outstanding: dict[bytes, _Sent] = {}  # by stamp, oldest first

    def seen(self, connection: object, stamp: bytes) -> None:
        """Note the last acknowledged stamp on a connection; unknown ones are ignored."""
        if stamp not in self._outstanding:  # nothing new, the usual case
            return
        with self._lock:
            last = self._outstanding.get(stamp)
            if last is None or last.connection is not connection:
                return
            for earlier, sent in list(self._outstanding.items()):
                if sent.connection is connection:
                    del self._outstanding[earlier]
                if sent is last:
                    return

    def send_at_once(self, connection: object, send: Send) -> bool:
        """Call `send` for at most 16 KiB if it cannot block; return whether it was called."""
        if not self._gate.acquire(blocking=False):
            return False
        try:
            stamp = os.urandom(STAMP_BYTES)
            with self._lock:
                if self._blockable or (self._outstanding and self._full(connection)):
                    return False
                # `_Sent(...)` would cost one more Python call.
                self._outstanding[stamp] = tuple.__new__(_Sent, (connection, self._clock(), False))
            send(stamp)
            return True
        finally:
            self._gate.release()

    def _full(self, connection: object) -> bool:
        """Whether the bytes in flight may fill the buffers. Under the lock."""
        self._forget_old(connection)
        full = len(self._outstanding) >= CREDIT_LIMIT
        return full or any(sent.may_block for sent in self._outstanding.values())

    def _forget_old(self, connection: object) -> None:
        """Forget replies sent on other connections long ago. Under the lock."""
        since = self._clock() - _OTHERS_COUNT_FOR_S
        for stamp, sent in list(self._outstanding.items()):
            if sent.connection is not connection and sent.at < since:
                del self._outstanding[stamp]

    def send(self, connection: object, send: Send) -> None:
        """Call `send`, which may block. `send_at_once` declines until it is acknowledged."""
        stamp = os.urandom(STAMP_BYTES)
        with self._gate, self._lock:
            self._blockable += 1
            outstanding = self._outstanding.items()  # acknowledging this one covers those before it
            self._outstanding = {s: o for s, o in outstanding if o.connection is not connection}
            self._forget_old(connection)
            self._outstanding[stamp] = _Sent(connection, math.inf, may_block=True)  # in progress
        try:
            send(stamp)
        finally:
            with self._lock:
                self._blockable -= 1
                if stamp in self._outstanding:
                    self._outstanding[stamp] = _Sent(connection, self._clock(), may_block=True)


OF_ONE_LIMIT = 32  # streams per holder, so that no holder can evict another's


class Stream:
    """One connection's open query, with `ReplyCredit`'s methods for that connection. Any thread."""

    def __init__(
        self, query: zenoh.Query, credit: ReplyCredit, holder: str, slow: Callable[[str], bool]
    ) -> None:
        self.query = query
        self.holder = holder
        self.slow = partial(slow, holder)  # whether its link is known to be slow
        name = object()  # identifies this connection without keeping the query, which ends with us
        self.seen = partial(credit.seen, name)
        self.send = partial(credit.send, name)
        self.send_at_once = partial(credit.send_at_once, name)


class Streams:
    """The open queries for answers, by token. `slow` tells whether a holder has a slow link."""

    limit = 1024  # a replica has 128 sessions; the rest belong to connections that are gone

    def __init__(self, slow: Callable[[str], bool] = lambda _: False) -> None:
        self._slow = slow
        self._lock = threading.Lock()
        self._streams: OrderedDict[bytes, Stream] = OrderedDict()
        self.of = self._streams.get  # by token; None if it has opened none. Called per request
        self._credit: WeakValueDictionary[str, ReplyCredit] = WeakValueDictionary()

    def opened(
        self, token: bytes, query: zenoh.Query, holder: str
    ) -> list[tuple[bytes, zenoh.Query]]:
        """Add a connection's query; return the ones to end, with their tokens."""
        ended = []
        with self._lock:
            if token in self._streams:
                ended.append((token, self._streams.pop(token).query))
            credit = self._credit.setdefault(holder, ReplyCredit())
            self._streams[token] = Stream(query, credit, holder, self._slow)
            own = [other for other, one in self._streams.items() if one.holder == holder]
            if len(own) > OF_ONE_LIMIT or len(self._streams) > self.limit:
                oldest = own[0] if len(own) > OF_ONE_LIMIT else next(iter(self._streams))
                ended.append((oldest, self._streams.pop(oldest).query))
        return ended

    def clear(self) -> None:
        """Remove all queries."""
        with self._lock:
            self._streams.clear()
