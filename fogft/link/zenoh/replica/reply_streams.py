"""The query that carries each connection's replies, and its unacknowledged bytes.

Replying blocks only where the robot takes nothing and all buffers on the way are full. So who must
not block may reply himself while no more is on the way than those surely hold. What has arrived is
known by stamps: each reply carries a random one, and the robot's requests say the last that it has
seen, so no robot can make others wait by saying what is not so.

All connections of a robot count together: they may share one socket. What was sent over another one
counts for a minute after it was sent, since that one may be gone.

Whoever asks again under one token, or whose connection is the oldest of too many, has its former
query ended, and opens another connection.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple
from weakref import WeakValueDictionary

from fogft.link.frame import STAMP_BYTES

if TYPE_CHECKING:
    import zenoh

CREDIT_LIMIT = 4  # replies of 16 KiB: 64 KiB, for the same reason
_OTHERS_COUNT_FOR_S = 60.0

Send = Callable[[bytes], None]  # takes the stamp


class _Sent(NamedTuple):
    connection: object
    at: float  # when that ended
    may_block: bool  # it was sent by somebody who may


class ReplyCredit:
    """The replies that one robot has not acknowledged. Any thread."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._gate = threading.Lock()  # held by who sends at once, which does not take long
        self._lock = threading.Lock()
        self._blockable = 0  # senders under way who may block
        self._outstanding: dict[bytes, _Sent] = {}  # by stamp, oldest first

    def seen(self, connection: object, stamp: bytes) -> None:
        """Note the last acknowledged stamp on a connection; unknown ones are ignored."""
        if stamp not in self._outstanding:  # nothing new, as mostly
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
                # `_Sent(...)` would be one more call of Python.
                self._outstanding[stamp] = tuple.__new__(_Sent, (connection, self._clock(), False))
            send(stamp)
            return True
        finally:
            self._gate.release()

    def _full(self, connection: object) -> bool:
        """Whether all that buffers surely hold may be on the way. Under the lock."""
        self._forget_old(connection)
        full = len(self._outstanding) >= CREDIT_LIMIT
        return full or any(sent.may_block for sent in self._outstanding.values())

    def _forget_old(self, connection: object) -> None:
        """Forget what was sent on other connections long ago. Under the lock."""
        since = self._clock() - _OTHERS_COUNT_FOR_S
        for stamp, sent in list(self._outstanding.items()):
            if sent.connection is not connection and sent.at < since:
                del self._outstanding[stamp]

    def send(self, connection: object, send: Send) -> None:
        """Call `send`, which may block. Until it is acknowledged, nothing is sent at once."""
        stamp = os.urandom(STAMP_BYTES)
        with self._gate, self._lock:
            self._blockable += 1
            outstanding = self._outstanding.items()  # who sees this has seen those before it
            self._outstanding = {s: o for s, o in outstanding if o.connection is not connection}
            self._forget_old(connection)
            self._outstanding[stamp] = _Sent(connection, math.inf, may_block=True)  # it goes on
        try:
            send(stamp)
        finally:
            with self._lock:
                self._blockable -= 1
                if stamp in self._outstanding:
                    self._outstanding[stamp] = _Sent(connection, self._clock(), may_block=True)


OF_ONE_LIMIT = 32  # of one holder: nobody's connections push out another's


class Stream:
    """One connection's open query, with `ReplyCredit`'s methods for that connection. Any thread."""

    def __init__(
        self, query: zenoh.Query, credit: ReplyCredit, holder: str, slow: Callable[[str], bool]
    ) -> None:
        self.query = query
        self.holder = holder
        self.slow = partial(slow, holder)  # whether it is known to read slowly
        name = object()  # of this connection: it must not keep the query, which ends with us
        self.seen = partial(credit.seen, name)
        self.send = partial(credit.send, name)
        self.send_at_once = partial(credit.send_at_once, name)


class Streams:
    """The open queries for answers, by token. Known to read slowly is a holder who is `slow`."""

    limit = 1024  # a replica has 128 sessions; the others are those of connections that are gone

    def __init__(self, slow: Callable[[str], bool] = lambda _: False) -> None:
        self._slow = slow
        self._lock = threading.Lock()
        self._streams: OrderedDict[bytes, Stream] = OrderedDict()
        self.of = self._streams.get  # by token, if it has asked one; for each request
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
