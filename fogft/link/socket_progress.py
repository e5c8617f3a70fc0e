"""Measure one connection's throughput, detect stalls, and decline requests that would be late.

1 MB needs eight seconds at 1 Mbit/s, so a slow send is a fault only if no bytes move at all.
The kernel counts the bytes that the peer acknowledged, so no time-out has to be guessed.

A request that would be late at the measured rate is declined at once, and may go elsewhere. A rate
is valid for ten seconds only: then a request is let through, which measures the link again.
"""

import logging
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from statistics import median_high

from fogft.counters import Counters
from fogft.link.compression import Compression
from fogft.link.window import OpenAttempt

SPAN_S = 0.5
ENOUGH = 4  # spans before requests are declined: longer than any pause that is not a loss
_MORE = 4  # times the rate; less may be one step of acknowledgements
KEPT_S = 10.0  # how long a span counts; then the link is measured again


class Throughput:
    """The throughput of one connection. Times are monotonic seconds.

    `steady_bytes_per_s` is the better rate of two spans in a row; None once clearly exceeded.
    """

    def __init__(self) -> None:
        self.steady_bytes_per_s: float | None = None
        self.spans: tuple[tuple[float, float], ...] = ()  # replaced, never mutated: any thread
        self._before: float | None = None  # the rate of the span before this one
        self._open = False  # whether a span has begun
        self._moved = 0
        self._lasted_s = 0.0
        self._still_s = 0.0  # since the last acknowledgement

    def look(self, moved: int, lasted_s: float, now: float, *, queued: bool) -> None:
        """Add the bytes acknowledged in `lasted_s`; `queued`: more were waiting all that time."""
        self._still_s += lasted_s
        if not queued:
            self._open, self._before = False, None
            steady = self.steady_bytes_per_s
            if steady is not None and moved > _MORE * steady * self._still_s:
                self.steady_bytes_per_s = None  # it has become faster
        elif moved:
            self._step(moved, self._still_s, now)
        if moved:
            self._still_s = 0.0

    def _step(self, moved: int, lasted_s: float, now: float) -> None:
        """Measure spans, which begin and end with an acknowledgement: these come in steps."""
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


BULK_BYTES = 16 << 10  # only more counts as a queue: even a frozen peer's kernel accepts less
_TRICKLE_BYTES = 2048  # less per look is not a flow: probe answers have a few hundred bytes
_SHARE_OF_NEW = 0.3  # weight of a new sample in the average rate
_SHORTEST_LOOK_S = 0.05


@dataclass(frozen=True)
class Flow:
    """The kernel's counters of one connection."""

    acknowledged: int  # bytes that the peer's kernel has acknowledged so far
    received: int  # bytes that came from the peer so far
    outstanding: int  # bytes handed to the kernel that are not acknowledged
    round_trip_s: float = 0.0  # smoothed time to an acknowledgement, plus four times its variation
    unsent: int = 0  # outstanding bytes that were not sent: the path takes no more now


class SocketProgress:
    """The progress of one connection. Times are monotonic seconds."""

    def __init__(self) -> None:
        self.throughput = Throughput()  # over some time
        self._last: Flow | None = None
        self._last_at = 0.0
        self._progress_at: float | None = None  # None: nothing is outstanding
        self._waited_s = 0.0  # with a queue, since the last look at which it had moved
        # Measured while more was queued than the kernel could send at once; None before that
        self.bytes_per_s: float | None = None

    def look(self, flow: Flow, now: float, sending_for_s: float = 0.0) -> float:
        """Take new counters; return for how many seconds since the last ones data moved.

        That time does not count as silence of the peer: its messages queue behind the data. The
        current large send has been passing bytes to the kernel for `sending_for_s`.
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
        # On a long path many bytes are in flight without any queue.
        full = sending or (last.unsent > 0 and flow.unsent > 0)
        self.throughput.look(moved, since_s, now, queued=full)
        if sending or (queued and flow.outstanding >= BULK_BYTES):
            rate, old = moved / since_s, self.bytes_per_s
            self.bytes_per_s = rate if old is None else old + _SHARE_OF_NEW * (rate - old)
        if (queued and moved > 0) or flow.received - last.received >= _TRICKLE_BYTES:
            waited_s, self._waited_s = self._waited_s, 0.0
            return waited_s + since_s
        # Acknowledgements come in steps: the wait for one counts as movement once it has come.
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
        """Whether the queue has not moved for longer than this path's normal pauses.

        The limit is at least `shortest_s`, as the peer's CPU may be busy, and at most `longest_s`,
        however slow the path is.
        """
        last = self._last
        if last is None or last.outstanding < BULK_BYTES:
            return False
        pause_s = max(shortest_s, 4 * last.round_trip_s)
        return self.stuck_s(now) > min(pause_s, longest_s)


log = logging.getLogger(__name__)


@dataclass(eq=False)
class DeadlineFilter:
    """Finds requests to `timed` services that would miss their deadline. Any thread.

    `carries` returns the link's rate (bytes per second) at a given time, None if unknown; `left`
    the bytes that have not arrived by then at that rate; `packs` a service's compression.
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
        """Whether an attempt may arrive in time behind the attempts that are sent `before` it."""
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
        """Return the expected size of an attempt on the wire; 0 if unknown."""
        compression = self.packs(attempt.service)
        if compression is None:
            return attempt.size
        ratio = compression.ratio
        return 0.0 if ratio is None else attempt.size * min(1.0, ratio)
