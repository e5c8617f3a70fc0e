"""End Zenoh queries, so that their callers do not wait for more replies.

Ending a query may block, so none of Zenoh's threads may do it. Nor may it be ended while Zenoh's
own thread still holds it: that thread would then be the last to release it, and would wait for room
that only it can make. So the threads of `reply_queue` end a query once that thread has moved on to
the next one (`turn`).
"""

import time
from collections.abc import Callable

import zenoh

from fogft.link import frame
from fogft.model import names

_NO_REQUEST = bytes(names.REQUEST_ID_BYTES)
_ANYWAY_S = 1.0  # by then Zenoh's thread has released it, even if no further query came


class QueryEnd:
    """A query to end, after sending a refusal if there is one. Created by Zenoh's thread.

    `turn` returns the number of the query that this thread is working on: the last one received.
    """

    def __init__(self, query: zenoh.Query, turn: Callable[[], int]) -> None:
        self.query = query
        self.refusal = ""
        self.turn = turn
        self._turn = turn()
        self._came_at = time.monotonic()

    def say(self) -> None:
        """Send the refusal. May block while the robot does not read. Raises zenoh.ZError."""
        if self.refusal:
            self.query.reply_err(frame.encode_refusal(frame.NO_STAMP, _NO_REQUEST, self.refusal))

    def ended(self) -> bool:
        """End the query if that is possible by now; return whether it was. May block like `say`."""
        held = self.turn() == self._turn and time.monotonic() - self._came_at <= _ANYWAY_S
        if not held:
            self.query.drop()  # type: ignore[no-untyped-call]
        return not held
