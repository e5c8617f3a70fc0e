"""What waits for the rest of its burst, to leave in one message with it.

Nothing waits for time to pass: whoever holds something knows of more to come, or calls `take`.

Owns: what is held, and how much. Not here: sending (`attempts`).
"""

from __future__ import annotations

import threading

from fogft.link.batch_frames import BYTES_LIMIT, LIMIT
from fogft.link.zenoh.robot.attempt import OpenAttempt


class BatchBuffer:
    """The attempts of one service at a time. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._attempts: list[OpenAttempt] = []
        self._bytes = 0

    def __bool__(self) -> bool:
        return bool(self._attempts)

    def add(self, attempt: OpenAttempt) -> list[OpenAttempt]:
        """Hold a small attempt; return those that leave now because it does not fit to them."""
        with self._lock:
            full = (
                len(self._attempts) >= LIMIT
                or self._bytes + attempt.size > BYTES_LIMIT
                or (self._attempts and self._attempts[0].service != attempt.service)
            )
            leaving = self._take() if full else []
            self._attempts.append(attempt)
            self._bytes += attempt.size
            return leaving

    def take(self) -> list[OpenAttempt]:
        """Return all that is held, in order."""
        if not self._attempts:  # the usual case, without the lock
            return []
        with self._lock:
            return self._take()

    def _take(self) -> list[OpenAttempt]:
        taken, self._attempts, self._bytes = self._attempts, [], 0
        return taken
