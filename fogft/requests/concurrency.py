"""How many requests a service may have concurrently, given or learned from latency. Pure.

What waits inside a service nobody can take back or overtake. How many it works on shows in its
throughput, limit / latency: docs/design/server-proxy.md. Who waits is `fair_queue`'s.
"""

from bisect import insort

QUICK_S = 0.003  # one that answers as often is not limited: what waits is over before it matters
IN_HAND_S = 0.1  # below this, one more is in hand
_NEAR = 0.85
_SAMPLES = 30
_TRY_AGAIN_S = 60.0
_WEIGHT = 0.1  # of a sample in the mean
# A call of seconds must not stand for all others: it counts as so many usual ones, and of so many
# first calls, which may load what they need, the median counts.
_OUTLIER, _FIRST = 10.0, 20


class ConcurrencyLimit:
    """The limit of one service: `given`, or learned, up to the `most` that its own queue holds."""

    def __init__(self, most: int, given: int | None = None) -> None:
        self._most = most
        self._given = given
        self.limit = most if given is None else given
        self.known = given or 0  # the limit, if given or learned; else 0
        self.takes_s = 0.0  # recent service time of a request, in seconds; 0 before the first
        self.service_s = 0.0  # the same, divided by how many were at work
        self._first_s: list[float] = []  # what the first ones took, in order
        # Of the limit in force, while as many as it allows were at work:
        self._took_s: list[float] = []
        self._kept: tuple[int, float] | None = None  # during a trial: the limit to compare with
        self._tried: dict[int, float] = {}  # when each limit was last found not to be better
        self.in_hand = self.limit  # how many the service is given

    def finished(self, level: int, took_s: float, now: float) -> None:
        """Learn from an answer; at its start `level` requests were running, itself included."""
        weight = _WEIGHT if self.takes_s else 1.0
        self.takes_s = self.takes_s * (1 - weight) + weight * took_s
        each_s = took_s / max(1, level)
        if len(self._first_s) < _FIRST:
            insort(self._first_s, each_s)
            self.service_s = self._first_s[(len(self._first_s) - 1) // 2]
        else:
            most_s = _OUTLIER * self.service_s or each_s
            self.service_s += _WEIGHT * (min(each_s, most_s) - self.service_s)
        if self._given is not None:
            return
        if level == self.limit:
            self._took_s.append(took_s)
            if len(self._took_s) >= _SAMPLES:
                self._judge(now)
        on_trial = not self._tried or self._kept is not None
        more = 0 if on_trial or self.takes_s >= IN_HAND_S else 1
        self.in_hand = min(self.limit + more, max(self.limit, self._most))

    def _judge(self, now: float) -> None:
        """Enough was seen of this limit: end a trial, or begin one."""
        quicker = sorted(self._took_s)[: len(self._took_s) * 2 // 3]  # what waits behind one stall
        each_s = sum(quicker) / len(quicker) / self.limit  # per answer
        rate = 1.0 / max(each_s, 1e-9)
        tried, kept = self.limit, self._kept
        self._kept = None
        if kept is not None:
            limit_before, rate_before = kept
            if rate < rate_before * (_NEAR if tried < limit_before else 1.0 / _NEAR):
                self._tried[tried] = now
                self._set(limit_before)
                return
        self._set(tried)
        half = tried if each_s < QUICK_S else max(tried // 2, 1)
        for candidate in (half, min(2 * tried, self._most)):
            last = self._tried.get(candidate)
            if candidate != tried and (last is None or now - last >= _TRY_AGAIN_S):
                self._kept = (tried, rate)
                self._tried[tried] = now  # so that it does not swing between the two
                self._set(candidate)
                return

    def _set(self, limit: int) -> None:
        self.limit = limit
        self.known = limit if self._tried else 0
        self._took_s = []

    def wait_s(self, ahead: int, at_work: int) -> float:
        """Return the expected wait behind those `ahead` and `at_work`, if known."""
        return max(0, ahead + at_work + 1 - self.limit) * self.takes_s / self.limit
