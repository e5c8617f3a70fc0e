"""End Zenoh queries, so that their callers do not wait for more replies.

Ending one may block, and none of Zenoh's threads may do it; nor must it be done while Zenoh's own
thread still holds that query: then that thread would be the last to let go, and would wait for room
that only it can make. So a query is ended when that thread has come to the next one (`turn`),
by the threads of `reply_queue`.
"""

import time
from collections.abc import Callable

import zenoh

from fogft.link import frame
from fogft.model import names

_NO_REQUEST = bytes(names.REQUEST_ID_BYTES)
_ANYWAY_S = 1.0  # Zenoh's thread has long let go, though nothing came after


class QueryEnd:
    """A query to end, after sending a refusal if there is one. Made by Zenoh's thread.

    `turn` returns which query that thread is working on: the last one received.
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
        """End the query if that may be done by now; return whether. May block like `say`."""
        held = self.turn() == self._turn and time.monotonic() - self._came_at <= _ANYWAY_S
        if not held:
            self.query.drop()  # type: ignore[no-untyped-call]
        return not held
