"""Where the answers of each connection leave: a query of its own, which stays open.

A connection asks it once, after it has greeted; every answer, and every refusal, is a reply to it.
Whoever asks again under one token, or whose connection is the oldest of too many, has its former
query ended, and opens another connection.

Owns: which query is whose. Not here: who is let in (`sessions`), what may leave at once (`credit`),
the threads that may block (`reply_queue`).
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

from fogft.link.zenoh.replica.reply_credit import ReplyCredit, Send

if TYPE_CHECKING:
    import zenoh

LIMIT = 1024  # a replica has 128 sessions; the others are those of connections that are gone


class Stream:
    """One connection's open query. Any thread.

    Args:
        credit: What is on the way to its robot.
    """

    __slots__ = ("_credit", "_name", "query")

    def __init__(self, query: zenoh.Query, credit: ReplyCredit | None = None) -> None:
        self.query = query
        self._credit = credit or ReplyCredit()
        self._name = object()  # which must not keep the query: that ends with us

    def seen(self, stamp: bytes) -> None:
        """Note the last stamp that the robot says it has seen; one that is not known is fine."""
        self._credit.seen(self._name, stamp)

    def send_at_once(self, send: Send) -> bool:
        """Call `send` for something of at most 16 KiB where it cannot block; return whether."""
        return self._credit.send_at_once(self._name, send)

    def send(self, send: Send) -> None:
        """Call `send`, which may block, for anything. At once nothing leaves until it was seen."""
        self._credit.send(self._name, send)


class Streams:
    """The open queries for answers, by the token of their connection.

    Args:
        limit: Beyond it the oldest are let go.
        slow: Whether the holder of a certificate is known to read slowly.
    """

    def __init__(self, limit: int = LIMIT, slow: Callable[[str], bool] = lambda _: False) -> None:
        self._limit = limit
        self._slow = slow
        self._lock = threading.Lock()
        self._streams: OrderedDict[bytes, Stream] = OrderedDict()
        self._credit: WeakValueDictionary[str, ReplyCredit] = WeakValueDictionary()

    def opened(
        self, token: bytes, query: zenoh.Query, holder: str
    ) -> list[tuple[bytes, zenoh.Query]]:
        """Take a connection's query; return those, with their tokens, that are to be ended."""
        ended = []
        with self._lock:
            if token in self._streams:
                ended.append((token, self._streams.pop(token).query))
            credit = self._credit.get(holder)
            if credit is None:
                credit = self._credit[holder] = ReplyCredit(partial(self._slow, holder))
            self._streams[token] = Stream(query, credit)
            if len(self._streams) > self._limit:
                oldest, stream = self._streams.popitem(last=False)
                ended.append((oldest, stream.query))
        return ended

    def of(self, token: bytes) -> Stream | None:
        """Return the query of a connection, if it has asked one. Cheap, asked for each request."""
        return self._streams.get(token)

    def clear(self) -> None:
        """Let go of all."""
        with self._lock:
            self._streams.clear()
