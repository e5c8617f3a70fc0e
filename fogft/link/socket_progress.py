"""How fast one connection drains, since when it does not, and what cannot arrive in time over it.

1 MB needs eight seconds at 1 Mbit/s: a send that takes long is a fault only where nothing moves.
The kernel counts what the peer has acknowledged, so no time-out has to be guessed.

What would be too late at the rate that was seen is declined at once, and may go elsewhere. The rate
is known for ten seconds only: then a request is let through, by which the link is measured anew.
"""

import logging
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from statistics import median_high

from fogft.counters import Counters
from fogft.link.compression import Compression
from fogft.link.window import OpenAttempt

SPAN_S = 0.5
ENOUGH = 4  # spans, before anybody is turned away: longer than any pause that is no loss
_MORE = 4  # times; less may be a step
KEPT_S = 10.0  # then a link is measured anew


class Throughput:
    """The throughput of one connection. Times are monotonic seconds.

    `steady_bytes_per_s` is what two spans in a row carried at best, until more is seen.
    """

    def __init__(self) -> None:
        self.steady_bytes_per_s: float | None = None
        self.spans: tuple[tuple[float, float], ...] = ()  # replaced, never changed: any thread
        self._before: float | None = None  # the rate of the span before this one
        self._open = False  # whether a span has begun
        self._moved = 0
        self._lasted_s = 0.0
        self._still_s = 0.0  # since something was acknowledged

    def look(self, moved: int, lasted_s: float, now: float, *, queued: bool) -> None:
        """Take the bytes acknowledged since; `queued`: more were waiting the whole time."""
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
        self.spans = (*(span for span in self.spans if now - span[0] <= KEPT_S), (now, rate))
        self._before, self._moved, self._lasted_s = rate, 0, 0.0

    def bytes_per_s(self, now: float) -> float | None:
        """Return the recent throughput; None if unknown."""
        rates = [rate for at, rate in self.spans if now - at <= KEPT_S]
        return median_high(rates) if len(rates) >= ENOUGH else None


BULK_BYTES = 16 << 10  # only more is a queue: a frozen peer's kernel takes what is small
_TRICKLE_BYTES = 2048  # less in one look is no flow: probes' answers are a few hundred bytes
_SHARE_OF_NEW = 0.3  # in the average of the rate
_SHORTEST_LOOK_S = 0.05


@dataclass(frozen=True)
class Flow:
    """The kernel's counters of one connection."""

    acknowledged: int  # bytes that the peer's kernel has acknowledged so far
    received: int  # bytes that came from the peer so far
    outstanding: int  # bytes handed to the kernel that are not acknowledged
    round_trip_s: float = 0.0  # to an acknowledgement, smoothed, with four times its variation
    unsent: int = 0  # of those outstanding, what has not left: the path takes no more now


class SocketProgress:
    """The progress of one connection. Times are monotonic seconds."""

    def __init__(self) -> None:
        self.throughput = Throughput()  # over some time
        self._last: Flow | None = None
        self._last_at = 0.0
        self._progress_at: float | None = None  # None: nothing is outstanding
        self._waited_s = 0.0  # with a queue, since the last look that found it moved
        # Measured while more waited than the kernel could send at once; None before that
        self.bytes_per_s: float | None = None

    def look(self, flow: Flow, now: float, sending_for_s: float = 0.0) -> float:
        """Take a new count; return for how many seconds since the last one data moved.

        These are not to be held against the peer: whatever it says queues behind that. Something
        large has been on its way into the kernel for `sending_for_s`.
        """
        last, since_s = self._last, now - self._last_at
        if last is not None and since_s < _SHORTEST_LOOK_S:
            return 0.0
        self._last, self._last_at = flow, now
        if last is None or flow.acknowledged > last.acknowledged or not flow.outstanding:
            self._progress_at = now if flow.outstanding else None
        elif self._progress_at is None:
            self._progress_at = now
        if last is None:
            return 0.0
        moved = flow.acknowledged - last.acknowledged
        sending = sending_for_s >= since_s
        queued = sending or last.outstanding >= BULK_BYTES
        # On a long path much is on its way without any queue.
        full = sending or (last.unsent > 0 and flow.unsent > 0)
        self.throughput.look(moved, since_s, now, queued=full)
        if sending or (queued and flow.outstanding >= BULK_BYTES):
            rate, old = moved / since_s, self.bytes_per_s
            self.bytes_per_s = rate if old is None else old + _SHARE_OF_NEW * (rate - old)
        if (queued and moved > 0) or flow.received - last.received >= _TRICKLE_BYTES:
            waited_s, self._waited_s = self._waited_s, 0.0
            return waited_s + since_s
        # Acknowledgements come in steps: what was waited for one counts when it has come.
        self._waited_s = self._waited_s + since_s if queued else 0.0
        return 0.0

    def left_bytes(self, now: float, bytes_per_s: float) -> float:
        """Return how many of the outstanding bytes have not arrived yet."""
        outstanding = self._last.outstanding if self._last is not None else 0
        return max(0.0, outstanding - bytes_per_s * (now - self._last_at))

    def stuck_s(self, now: float) -> float:
        """Return for how many seconds outstanding bytes have gone unacknowledged."""
        return 0.0 if self._progress_at is None else max(0.0, now - self._progress_at)

    def stalled(self, now: float, *, shortest_s: float, longest_s: float) -> bool:
        """Whether the queue has been still for longer than pauses of this path explain.

        At least for `shortest_s`: the peer's processor may be busy. However slow the path, no
        longer than `longest_s`.
        """
        last = self._last
        if last is None or last.outstanding < BULK_BYTES:
            return False
        pause_s = max(shortest_s, 4 * last.round_trip_s)
        return self.stuck_s(now) > min(pause_s, longest_s)


log = logging.getLogger(__name__)


@dataclass(eq=False)
class DeadlineFilter:
    """Judges the requests to `timed` services, of no use after their time. Any thread.

    `carries` returns the bytes a second that the link carries at a moment, None for not known;
    `left` the bytes that have not arrived by then at that rate; `packs` a service's compression.
    """

    timed: Collection[str]
    carries: Callable[[float], float | None]
    left: Callable[[float, float], float]
    packs: Callable[[str], Compression | None]
    _counters: Counters = field(default_factory=Counters, init=False)

    def may_arrive(
        self,
        attempt: OpenAttempt,
        remaining_s: float,
        now: float,
        before: Callable[[str], Iterable[OpenAttempt]] = lambda service: (),
    ) -> bool:
        """Whether an attempt may arrive in time behind what leaves `before` it."""
        rate = self.carries(now) if attempt.service in self.timed else None
        if rate is None:
            return True
        size = self.left(now, rate) + sum(
            map(self._on_the_way, (attempt, *before(attempt.service)))
        )
        if size <= rate * remaining_s:
            return True
        self._counters.warn(
            log, "declined", "request_too_slow service=%s bytes=%d bytes_per_s=%d remaining_s=%.3f",
            attempt.service, size, rate, remaining_s,
        )  # fmt: skip
        return False

    def _on_the_way(self, attempt: OpenAttempt) -> float:
        """Return how many bytes an attempt will be at least; 0 where that is not known."""
        compression = self.packs(attempt.service)
        if compression is None:
            return attempt.size
        ratio = compression.ratio
        return 0.0 if ratio is None else attempt.size * min(1.0, ratio)
