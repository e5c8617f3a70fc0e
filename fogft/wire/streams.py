"""Where the answers of each connection leave: a query of its own, which stays open.

A connection asks it once, after it has greeted; every answer, and every refusal, is a reply to it.
Whoever asks again under one token, or whose connection is the oldest of too many, has its former
query ended, and opens another connection.

Owns: which query is whose. Not here: who is let in (`guests`), replying (`reply_queue`).
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import zenoh

LIMIT = 1024  # a replica has 128 sessions; the others are those of connections that are gone


class Streams:
    """The open queries for answers, by the token of their connection.

    Args:
        limit: Beyond it the oldest are let go.
    """

    def __init__(self, limit: int = LIMIT) -> None:
        self._limit = limit
        self._lock = threading.Lock()
        self._streams: OrderedDict[bytes, zenoh.Query] = OrderedDict()

    def opened(self, token: bytes, query: zenoh.Query) -> list[tuple[bytes, zenoh.Query]]:
        """Take a connection's query; return those, with their tokens, that are to be ended."""
        ended = []
        with self._lock:
            if token in self._streams:
                ended.append((token, self._streams.pop(token)))
            self._streams[token] = query
            if len(self._streams) > self._limit:
                ended.append(self._streams.popitem(last=False))
        return ended

    def of(self, token: bytes) -> zenoh.Query | None:
        """Return the query of a connection, if it has asked one. Cheap, asked for each request."""
        return self._streams.get(token)

    def clear(self) -> None:
        """Let go of all."""
        with self._lock:
            self._streams.clear()
