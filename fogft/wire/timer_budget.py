"""Keep down the timers that Zenoh holds for queries. Pure: `now` is an argument.

Zenoh keeps a timer (about 0.5 KB) for each query until the query's time-out, whether or not
it was answered: 3000 requests/s with a time-out of 10 s hold 15 MB for each link, with 100 s
150 MB. So the busier a service, the shorter the time-out that Zenoh is told; a quiet one is
told all the time that is left.

A query that ends before its request's deadline is an attempt that was lost: it is sent again
under the same id and joins the work in progress. That is rare: at most 512 attempts are open
on a link, so the answers of a service that is asked `rate` times a second take 512 / rate
seconds on average, a twentieth of what is allowed here.
"""

from __future__ import annotations

TIMERS_LIMIT = 10_000
SHORTEST_S = 1.0


class TimerBudget:
    """The timers of one service on one connection.

    Args:
        limit: About how many may be pending while requests come steadily.
    """

    def __init__(self, limit: int = TIMERS_LIMIT) -> None:
        self._limit = limit
        self._second = 0
        self._count = 0  # queries in this second
        self._before = 0  # and in the one before it

    def timeout_s(self, wanted_s: float, now: float) -> float:
        """Count a query at `now`; return its time-out: `wanted_s`, or less when many come."""
        second = int(now)
        if second != self._second:
            self._before = self._count if second == self._second + 1 else 0
            self._second, self._count = second, 0
        self._count += 1
        rate = max(self._count, self._before)
        return min(wanted_s, max(SHORTEST_S, self._limit / rate))
