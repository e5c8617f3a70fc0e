"""The concurrency limit of a service, configured or learned from latency. Pure.

A request queued inside a service cannot be cancelled or overtaken. How many the service runs at
once shows in its throughput, limit / latency: docs/design/server-proxy.md. Queue: `fair_queue`.
"""

from bisect import insort

QUICK_S = 0.003  # a limit below this time per answer is never lowered: waits are negligible
IN_HAND_S = 0.1  # a service quicker than this holds one extra request, so it never idles
_NEAR = 0.85
_SAMPLES = 30
_TRY_AGAIN_S = 60.0
_WEIGHT = 0.1  # of a sample in the mean
# One call of seconds must not dominate the mean: a sample is capped at this multiple of the mean.
# The median of this many first calls is used, as they may load a model or data.
_OUTLIER, _FIRST = 10.0, 20


class ConcurrencyLimit:
    """The limit of one service: `given`, or learned up to `most`, the length of its own queue."""

    def __init__(self, most: int, given: int | None = None) -> None:
        self._most = most
        self._given = given
        self.limit = most if given is None else given
        self.known = given or 0  # the limit, if given or learned; else 0
        self.takes_s = 0.0  # recent service time of a request, in seconds; 0 before the first
        self.service_s = 0.0  # the same, divided by how many were running
        self._first_s: list[float] = []  # service times of the first requests, sorted
        # Service times under the current limit, from requests that started when it was reached:
        self._took_s: list[float] = []
        self._kept: tuple[int, float] | None = None  # during a trial: the limit to compare with
        self._tried: dict[int, float] = {}  # when each limit was last found not to be better
        self.in_hand = self.limit  # how many requests the service is given at once

    def finished(self, level: int, took_s: float, now: float) -> None:
        """Learn from an answer; `level` requests ran when it started, including its own."""
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
        """End a trial or begin one, once there are enough samples of the current limit."""
        quicker = sorted(self._took_s)[: len(self._took_s) * 2 // 3]  # without waits behind a stall
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
                self._tried[tried] = now  # so that the limit does not oscillate between the two
                self._set(candidate)
                return

    def _set(self, limit: int) -> None:
        self.limit = limit
        self.known = limit if self._tried else 0
        self._took_s = []

    def wait_s(self, ahead: int, at_work: int) -> float:
        """Return the expected wait behind `ahead` queued and `at_work` running requests; or 0."""
        return max(0, ahead + at_work + 1 - self.limit) * self.takes_s / self.limit
