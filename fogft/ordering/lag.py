"""Decide when a replica that falls behind is given a snapshot instead of what it lacks. Pure.

The first answer counts, so callers go as fast as the fastest replica. A slower one falls
behind for as long as that lasts; should the faster ones die, every caller would wait until it
has applied all that it lacks.

Owns: the limit, and how often.
"""

from __future__ import annotations

# Further behind than this, a replica is given a new snapshot rather than every request since.
LIMIT = 256
FIRST_S = 2.0
LONGEST_S = 16.0


class Lag:
    """How one replica keeps up. A snapshot costs its giver a pause: the next ones come rarer."""

    def __init__(self) -> None:
        self._wait_s = FIRST_S
        self._next_at = 0.0

    def too_far(self, behind: int, now: float) -> bool:
        """Whether a replica so many requests behind is to be restored now.

        Args:
            behind: Requests that were numbered and that it has not answered.
            now: In seconds.
        """
        if behind <= LIMIT:
            if now >= self._next_at + self._wait_s:
                self._wait_s = FIRST_S  # it has kept up for as long again
            return False
        if now < self._next_at:
            return False
        self._next_at = now + self._wait_s
        self._wait_s = min(2 * self._wait_s, LONGEST_S)
        return True
