"""End Zenoh queries, so that their callers do not wait for more replies.

Ending one may block, and none of Zenoh's threads may do it; nor must it be done while Zenoh's own
thread still holds that query: then that thread would be the last to let go, and would wait for room
that only it can make. So a query is ended when that thread has come to the next one (`QueryTurns`),
by the threads of `reply_queue`.
"""

from __future__ import annotations

import time

import zenoh

from fogft.link import frame
from fogft.model import names

_NO_REQUEST = bytes(names.REQUEST_ID_BYTES)
_ANYWAY_S = 1.0  # Zenoh's thread has long let go, though nothing came after


class QueryTurns:
    """The query that Zenoh's thread is working on: the last one received."""

    def __init__(self) -> None:
        self.last = 0

    def came(self) -> int:
        """Count a query. Called first by Zenoh's thread."""
        self.last += 1
        return self.last

    def over(self, turn: int) -> bool:
        """Whether Zenoh's thread has finished with a query."""
        return turn < self.last


class QueryEnd:
    """A query to end, after sending a refusal if there is one; `turn`: when it came."""

    def __init__(self, query: zenoh.Query, turn: int) -> None:
        self.query = query
        self.turn = turn
        self.refusal = ""
        self._ended = False

    def say(self) -> None:
        """Send the refusal. May block while the robot does not read. Raises zenoh.ZError."""
        if self.refusal:
            self.query.reply_err(frame.encode_refusal(frame.NO_STAMP, _NO_REQUEST, self.refusal))

    def end(self) -> None:
        """End the query. May block like `say`."""
        if not self._ended:
            self._ended = True
            self.query.drop()  # type: ignore[no-untyped-call]


class Unended:
    """The queries that one thread has yet to end."""

    def __init__(self, turns: QueryTurns) -> None:
        self._turns = turns
        self._ends: list[tuple[float, QueryEnd]] = []

    def __bool__(self) -> bool:
        return bool(self._ends)

    def add(self, one: QueryEnd) -> None:
        """End a query now, or as soon as it may be."""
        if self._turns.over(one.turn):
            one.end()
        else:
            self._ends.append((time.monotonic(), one))

    def look(self) -> None:
        """End all queries that may be ended by now."""
        waiting, self._ends = self._ends, []
        for since, one in waiting:
            if self._turns.over(one.turn) or time.monotonic() - since > _ANYWAY_S:
                one.end()
            else:
                self._ends.append((since, one))
