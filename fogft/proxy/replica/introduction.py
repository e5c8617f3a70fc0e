"""Whether a service that has just begun has found us: until then rmw drops what it responds.

A participant tells of its readers in the order in which they were made. So the answer to a call of
the client that was made last vouches for those before it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from fogft.errors import RosError
from fogft.ros.port import RosClient

_AGAIN_AFTER_S, _TIMES = 1.0, 3.0


class Introduction:
    """Calls a service until it has answered.

    Args:
        client: That of the service.
        request: What changes nothing, serialised.
    """

    def __init__(self, client: RosClient, request: bytes, clock: Callable[[], float]) -> None:
        self._client, self._request, self._clock = client, request, clock
        self._answered = False
        self._next_at, self._pause_s = 0.0, _AGAIN_AFTER_S

    def anew(self) -> Introduction:
        """Return one for the service that came in place of that."""
        return Introduction(self._client, self._request, self._clock)

    def done(self) -> bool:
        """Return whether it has answered; if not, call it when that is due. At about 10 Hz."""
        now = self._clock()
        if not self._answered and now >= self._next_at and self._client.available():
            self._next_at, self._pause_s = now + self._pause_s, _TIMES * self._pause_s
            with contextlib.suppress(RosError):  # the next call may be taken
                self._client.call(self._request, self._heard)
        return self._answered

    def _heard(self, answer: bytes) -> None:
        self._answered = True
