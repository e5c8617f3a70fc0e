"""The requests that a connection has sent and to which no answer has come. No clock, no Zenoh.

Also those that have ended since, by their deadline or because another replica was faster: when
their answers come, they are late, and need not be recalled any more.

Owns: whose answer may still come. Each step is one operation on a dictionary, which is atomic.
"""

from __future__ import annotations

from fogft.link.zenoh.robot.attempt import OpenAttempt

LIMIT = 8192  # the window holds 512; a replica that never answers what was forgotten holds no more


class Unanswered:
    """What one connection has sent, by request id.

    Args:
        limit: Beyond it the oldest are forgotten.
    """

    def __init__(self, limit: int = LIMIT) -> None:
        self._limit = limit
        self._attempts: dict[bytes, OpenAttempt] = {}

    def __len__(self) -> int:
        return len(self._attempts)

    def add(self, attempt: OpenAttempt) -> None:
        """Note an attempt that is about to be sent; it takes the place of one of its request."""
        self._attempts[attempt.request_id] = attempt
        if len(self._attempts) > self._limit:
            for id in list(self._attempts)[: self._limit // 8]:
                self._attempts.pop(id, None)

    def answered(self, request_id: bytes) -> OpenAttempt | None:
        """Return whom an answer is for, once; None if nobody awaits it."""
        return self._attempts.pop(request_id, None)
