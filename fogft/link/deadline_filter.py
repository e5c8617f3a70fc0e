"""Decline requests that cannot arrive before their deadline over a slow link.

Where more is asked of a thin link than it carries, each request leaves after those before it, with
too little of its time left: every one arrives too late, and none in time. So the window follows
from the rate that the link was seen to carry (`socket_progress`) and from the time that is left;
who is declined at once may be sent on another uplink, or to another replica.

Known for ten seconds only: then a request is let through again, by which the link is measured anew.

Owns: the judgement. Not here: rates, the bounds by bytes and by count (`window`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable

from fogft.link.compression import Compression
from fogft.link.window import OpenAttempt
from fogft.log_limits import worth_logging

log = logging.getLogger(__name__)


class DeadlineFilter:
    """Judges the requests of one connection. Any thread.

    Args:
        carries: Returns what the link carries, by the clock, in bytes a second; None where that is
            not known.
        left: Returns how many bytes sent before have not arrived, by the clock and that rate.
    """

    def __init__(
        self,
        timed: Collection[str],
        carries: Callable[[float], float | None],
        left: Callable[[float, float], float],
        packs: Callable[[str], Compression | None],
    ) -> None:
        self.declined = 0
        self._timed = timed
        self._carries = carries
        self._left = left
        self._packs = packs

    def may_arrive(
        self,
        attempt: OpenAttempt,
        remaining_s: float,
        now: float,
        before: Callable[[str], Iterable[OpenAttempt]] = lambda service: (),
    ) -> bool:
        """Whether an attempt may arrive in time behind what leaves `before` it."""
        rate = self._carries(now)
        if rate is None or attempt.service not in self._timed:
            return True
        size = self._left(now, rate) + sum(
            map(self._on_the_way, (attempt, *before(attempt.service)))
        )
        if size <= rate * remaining_s:
            return True
        self.declined += 1
        if worth_logging(self.declined):
            log.warning(
                "request_too_slow service=%s bytes=%d bytes_per_s=%d remaining_s=%.3f count=%d",
                attempt.service, size, rate, remaining_s, self.declined,
            )  # fmt: skip
        return False

    def _on_the_way(self, attempt: OpenAttempt) -> float:
        """Return how many bytes an attempt will be at least; 0 where that is not known."""
        compression = self._packs(attempt.service)
        if compression is None:
            return attempt.size
        ratio = compression.ratio
        return 0.0 if ratio is None else attempt.size * min(1.0, ratio)
