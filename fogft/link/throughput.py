"""What a connection was seen to carry while more waited than it took. Pure.

What follows from it (`deadline_filter`, `reply_streams`) must not befall a link that only paused.
So nothing is known before several spans in which a queue stood and moved, and the middle one of
them counts: a pause makes one too slow, what buffers on the way take in makes one too fast.

Owns: these spans. Not here: what moved (`socket_progress`).
"""

from __future__ import annotations

from statistics import median_high

SPAN_S = 0.5
ENOUGH = 4  # spans, before anybody is turned away: longer than any pause that is no loss
_MORE = 4  # times; less may be a step
KEPT_S = 10.0  # then a link is measured anew


class Throughput:
    """Of one connection. Times are monotonic seconds.

    Attributes:
        steady_bytes_per_s: What two spans in a row carried at best, until more is seen; None
            before that.
    """

    def __init__(self) -> None:
        self.steady_bytes_per_s: float | None = None
        self._spans: tuple[tuple[float, float], ...] = ()  # replaced, never changed: any thread
        self._before: float | None = None  # the rate of the span before this one
        self._open = False  # whether a span has begun
        self._moved = 0
        self._lasted_s = 0.0
        self._still_s = 0.0  # since something was acknowledged

    def look(self, moved: int, lasted_s: float, now: float, *, queued: bool) -> None:
        """Take what was acknowledged since the last look.

        Args:
            moved: So many bytes.
            lasted_s: In so many seconds.
            queued: Whether more than that waited the whole time.
        """
        self._still_s += lasted_s
        if not queued:
            self._open, self._before = False, None
            steady = self.steady_bytes_per_s
            if steady is not None and moved > _MORE * steady * self._still_s:
                self.steady_bytes_per_s = None  # it carries more by now
        elif moved:
            self._step(moved, self._still_s, now)
        if moved:
            self._still_s = 0.0

    def _step(self, moved: int, lasted_s: float, now: float) -> None:
        """Acknowledgements come in steps, perhaps of many bytes: spans begin and end with one."""
        if not self._open:
            self._open, self._moved, self._lasted_s = True, 0, 0.0
            return
        self._moved += moved
        self._lasted_s += lasted_s
        if self._lasted_s < SPAN_S:
            return
        rate = self._moved / self._lasted_s
        if self._before is not None:
            self.steady_bytes_per_s = max(self._before, rate)
        self._spans = (*(span for span in self._spans if now - span[0] <= KEPT_S), (now, rate))
        self._before, self._moved, self._lasted_s = rate, 0, 0.0

    def bytes_per_s(self, now: float) -> float | None:
        """Return what it carries, as lately seen; None where that is not known."""
        if not self._spans:  # the usual case
            return None
        rates = [rate for at, rate in self._spans if now - at <= KEPT_S]
        return median_high(rates) if len(rates) >= ENOUGH else None
