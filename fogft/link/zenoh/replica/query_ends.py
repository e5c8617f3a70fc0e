"""End Zenoh queries, so that their callers do not wait for more replies.

Ending one sends something too, so it may block, and none of Zenoh's threads may do it. And it
must not be done while Zenoh's own thread still holds that query: then the last to let go would be
that thread, which would wait for room that only it can make, and with it every link of this
process would stand still. So a query is ended when that thread has come to the next one
(`QueryTurns`).

Owns: when a query may be ended. Not here: the thread that does it (`reply_queue`).
"""

from __future__ import annotations

import time

import zenoh

from fogft.link import frame
from fogft.model import names

_NO_REQUEST = bytes(names.REQUEST_ID_BYTES)
_ANYWAY_S = 1.0  # Zenoh's thread has long let go, though nothing came after


class QueryTurns:
    """Which query Zenoh's one thread has in its hands: the last that came."""

    def __init__(self) -> None:
        self.last = 0

    def came(self) -> int:
        """Count a query. Called by Zenoh's thread, first of all."""
        self.last += 1
        return self.last

    def over(self, turn: int) -> bool:
        """Whether Zenoh's thread has let go of a query."""
        return turn < self.last


class QueryEnd:
    """A query that is to be ended, after a refusal if there is one."""

    def __init__(self, query: zenoh.Query, turn: int) -> None:
        self.query = query
        self.turn = turn
        self.refusal = ""
        self._ended = False

    def say(self) -> None:
        """Send the refusal. May block while its robot takes nothing. Raises zenoh.ZError."""
        if self.refusal:
            self.query.reply_err(frame.encode_refusal(frame.NO_STAMP, _NO_REQUEST, self.refusal))

    def end(self) -> None:
        """End the query. May block as `say` does."""
        if not self._ended:
            self._ended = True
            self.query.drop()  # type: ignore[no-untyped-call]


class Unended:
    """What one thread has yet to end."""

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
        """End what may be ended by now."""
        waiting, self._ends = self._ends, []
        for since, one in waiting:
            if self._turns.over(one.turn) or time.monotonic() - since > _ANYWAY_S:
                one.end()
            else:
                self._ends.append((since, one))
