"""A replica's load, estimated from its reports and from what one robot has sent. Pure.

Between two reports a robot counts what it has sent itself. Robots need no coordination: each sees
the others' requests in the replica's reports. Which replica is asked: `auto` and `choose`.
"""

import math
from enum import IntFlag
from itertools import islice
from typing import NamedTuple

from fogft.requests.latency import Latencies

LATE_SHARE = 0.95
SHORTEST_DELAY_S = 0.001
UNKNOWN_DELAY_S = 0.1
_SAMPLES_NEEDED = 5  # with fewer, the 95 % quantile is just the maximum
_WORD_HOLDS_S = 1.0  # how long a replica's report about other robots' requests is valid
_RTT_GAIN = 0.1
NEARLY = 0.8  # a request is nearly done after this share of its usual time
# Factors from the median service time: up to the first, in the long-term average, no difference
# counts; beyond the second, in the recent one, a difference counts at once.
ALIKE, _ALIKE_LATELY = 1.7, 4.0
_USUAL_GAIN = 0.02
NEW = 20  # with fewer reports than this, a replica's averages say little
_FEW = 10  # with fewer answers, a replica cannot be compared with others
# Multiples of the expected time of an attempt, after which it is overdue, or stalls:
_LATE, _STALLS = 1.2, 3.0
_DOUBT_AFTER = 2.0
_UNKNOWN_DOUBT_S = 2.0  # as long as until a silent link is suspect
# Backoff from a replica that fails, doubling up to a limit, while another one is able.
_AVOIDED_S = 0.1
_AVOIDED_LIMIT_S = 5.0
NEVER = float("inf")
_MANY = 16.0  # behind more requests than this, a latency says little about what is unusual
_FULL_OVER_S, _ASKED_OVER_S, _DEMAND_STEP_S = 10.0, 30.0, 0.1
# An answer this many times slower than usual starts a slow spell of this many times its duration.
SLOW, _SLOW_FOR = 2.5, 5.0
_OFTEN = 0.5  # if requests queue for more than this share of the time, there are too few replicas
_UNANSWERED = 1.15  # requests per answer of full replicas above which it is no coincidence
_SILENT_S = 2.0  # after this long without an answer, whether replicas are full is unknown
_TOO_FULL, _ENOUGH = 0.95, 0.8  # utilization that is too high, and the target


class Handling(IntFlag):
    """How a replica should handle a request, besides running it."""

    NORMAL = 0
    DROP_IF_BUSY = 0x08  # a spare copy: drop it if it would have to wait
    ALONE = 0x10  # a service died while working on this: run nothing beside it


class Load(NamedTuple):  # created for each answer: a frozen dataclass costs three times as much
    """The load of one service, reported by a replica with each answer and refusal."""

    waiting: int  # requests waiting for their turn
    running: int  # requests that the service has now
    slots: int  # how many it works on at once; 0 if not known yet
    service_s: float  # recent time per request, divided by how many ran at once
    spent_s: float  # how long the request of this answer was at the replica


class Demand:
    """The demand for a service: this robot's, and all robots' as far as full replicas show it."""

    def __init__(self) -> None:
        self.full = False  # requests were waiting at the replica that answered last
        self.rate = 0.0  # recent requests per second; too low in the first seconds
        self._full_until = -NEVER  # unless another answer confirms it
        self._full_share = 0.0  # recent share of the time
        self._asked = 0.0  # recent requests
        self._asked_full = self._answered_full = 0.0  # recent requests and answers while full
        self._at = 0.0

    def asked(self, now: float) -> None:
        """Count a request."""
        if now > self._at + _DEMAND_STEP_S:
            kept = self._kept(now, _FULL_OVER_S)
            self._full_share, self._asked = self._share(now), self._asked * kept
            self.full = self.full and now < self._full_until
            self.rate = self._asked / _FULL_OVER_S
            kept = self._kept(now, _ASKED_OVER_S)
            self._asked_full *= kept
            self._answered_full *= kept
            self._at = now
        self._asked += 1.0
        self._asked_full += self.full

    def answered(self, load: Load, now: float) -> None:
        """Count an answer; not needed if `full` is not set and nothing waits at the replica."""
        self.full, self._full_until = load.waiting > 0, now + _SILENT_S
        self._answered_full += self.full

    def _kept(self, now: float, over_s: float) -> float:
        return math.exp((self._at - now) / over_s)

    def _share(self, now: float) -> float:
        kept, full = self._kept(now, _FULL_OVER_S), self.full and now < self._full_until
        return self._full_share * kept + (1.0 - kept) * full

    def replicas(self, able: int, service_s: float, now: float) -> int:
        """Return how many replicas would be enough, at `service_s` a request, if too few; else 0.

        Enough for this robot's demand; if full replicas leave requests unanswered, for all robots':
        replicas serve robots in turns, so robots with equal demand see the same shortage.
        """
        able, needed = max(1, able), 0
        work = self._asked * self._kept(now, _FULL_OVER_S) / _FULL_OVER_S * service_s
        if work > _TOO_FULL * able:
            needed = math.ceil(work / _ENOUGH)
        answered = self._answered_full
        if self._share(now) > _OFTEN and self._asked_full > _UNANSWERED * answered > 0.0:
            needed = max(needed, math.ceil(able * self._asked_full / answered / _ENOUGH))
        return needed


class ReplicaLoad:
    """One robot's estimate of a replica's load. Not thread-safe: its owner holds a lock."""

    def __init__(self) -> None:
        self.latencies = Latencies()
        self.service_s = 0.0  # recent time per request, as far as known
        self.usual_s = 0.0  # the same, averaged over a long time
        self.told = 0  # how many reports it has sent
        self.doubted = False  # an attempt is long overdue and none has ended since it began
        self.ended_at = -NEVER  # when it last ended an attempt, answered in time or late
        self.asked_at = -NEVER
        self.slow_until = -NEVER  # its last answer took unusually long: others are preferred
        # Our open attempts there, oldest first: when each began, when it is overdue, and the
        # weight of its latency.
        self.at_work: dict[bytes, tuple[float, float, float]] = {}
        self.slots = 0
        self._rtt_s: float | None = None
        self._others = 0  # other robots' requests there
        self._others_until = -NEVER
        self._avoided_s = 0.0
        self._avoided_until = -NEVER
        self.delay_s = UNKNOWN_DELAY_S  # an attempt that takes longer is unusually slow
        self._delay_holds_until = _SAMPLES_NEEDED

    # -- estimates ------------------------------------------------------------------------

    @property
    def alone_s(self) -> float:
        """Return how long an answer usually takes if nothing is ahead."""
        return (self._rtt_s or 0.0) + self.usual_s

    def ahead(self, now: float) -> int:
        """Return the estimated number of requests at the replica."""
        return len(self.at_work) + (self._others if now < self._others_until else 0)

    def free(self, now: float) -> bool:
        """Whether a request that arrives now is expected to start (almost) at once."""
        if self.doubted:
            return False
        ahead = self.ahead(now)
        if ahead < max(1, self.slots):
            return True
        # Only one request, ours, and nearly done: callers ask again once the first has answered.
        one, takes_s = ahead == len(self.at_work) == 1, (self._rtt_s or 0.0) + self.service_s
        return one and NEARLY * takes_s <= self._spent_s(now) <= _LATE * takes_s

    def wait_s(self, now: float) -> float:
        """Return the expected wait of a request that arrives now; infinity if doubted."""
        if self.doubted:
            return NEVER
        if self.free(now):
            return 0.0
        return self.service_s * max(1, self.ahead(now) + 1 - max(1, self.slots))

    @property
    def oldest_begun(self) -> float:
        """Return when the oldest of our open requests there began; infinity for none."""
        for begun, _, _ in self.at_work.values():
            return begun
        return NEVER

    def _spent_s(self, now: float) -> float:
        """Return how long it has been working on our oldest request; 0 for none."""
        return now - max(self.oldest_begun, self.ended_at) if self.at_work else 0.0

    def avoided(self, now: float) -> bool:
        """Whether to prefer others: the replica is doubted, or has failed recently."""
        return self.doubted or now < self._avoided_until

    def expected_s(self, now: float, typical_s: float, usual_s: float) -> float:
        """Return the expected latency of a request sent now.

        The round trip, plus one service time for it and for each request ahead, less the time
        already spent on the running one; a stalled one is expected to take as long again. A
        replica about as quick as the median, or with few answers, counts as equal to it: the median
        takes `typical_s` per request recently, `usual_s` over a long time.
        """
        service_s = self.service_s
        if self.latencies.samples < _FEW:
            service_s = typical_s or SHORTEST_DELAY_S  # if no median: the fewest ahead decides
        elif typical_s / _ALIKE_LATELY < service_s < typical_s * _ALIKE_LATELY:
            service_s = self.usual_s
            if usual_s / ALIKE < service_s < usual_s * ALIKE:
                service_s = typical_s
        rtt_s = self._rtt_s or 0.0
        left_s = service_s * (1 + self.ahead(now))
        if not self.at_work:
            return rtt_s + left_s
        spent_s = self._spent_s(now)
        if spent_s <= _LATE * (rtt_s + service_s):
            left_s -= min(spent_s, NEARLY * service_s)  # never as good as an idle replica
        elif spent_s > _STALLS * (rtt_s + service_s):
            left_s += spent_s
        return rtt_s + left_s

    def overdue_at(self, request: bytes, begun: float) -> float:
        """Return when an attempt becomes slower than nearly all others and than expected."""
        return self.at_work.get(request, (0.0, begun + self.delay_s, 1.0))[1]

    def doubtful_at(self, begun: float) -> float:
        """Return when an attempt that began at `begun` is long overdue.

        That is later than when it is unusually slow, as one attempt in twenty is. For a replica
        with few answers it is some seconds.
        """
        if self.latencies.samples < _SAMPLES_NEEDED:
            return begun + _UNKNOWN_DOUBT_S
        return begun + _DOUBT_AFTER * self.delay_s

    # -- events ---------------------------------------------------------------------------

    def asked(self, request: bytes, now: float, *, spare: bool = False) -> float:
        """Note an attempt about to be sent; return when it will be overdue."""
        ahead = self.ahead(now)
        overdue_s = _LATE * max(self.delay_s, (self._rtt_s or 0.0) + self.service_s * (1 + ahead))
        # A spare copy to a slow replica is no sample: requests avoid it meanwhile.
        share = 0.0 if spare and now < self.slow_until else min(1.0, (_MANY / (1 + ahead)) ** 2)
        self.at_work[request] = now, now + overdue_s, share
        self.asked_at = now
        return now + overdue_s

    def heard(self, request: bytes, load: Load, now: float) -> None:
        """Take its reported load, plus our requests sent within the last round trip."""
        since = now - (self._rtt_s or 0.0)
        seen = len(self.at_work) - (request in self.at_work)
        for id, (begun, _, _) in reversed(self.at_work.items()):  # newest first: only a few
            if begun <= since:
                break
            seen -= id != request
        there = load.waiting + load.running
        self._others, self._others_until = max(0, there - seen), now + _WORD_HOLDS_S
        self.slots = load.slots
        self.service_s = load.service_s
        self.told += 1
        gain = max(_USUAL_GAIN, 1.0 / max(1, self.told - NEW))
        self.usual_s += gain * (load.service_s - self.usual_s)
        if seen > there:  # we were not told of the end of some
            for lost in [*islice((id for id in self.at_work if id != request), seen - there)]:
                del self.at_work[lost]

    def answered(self, request: bytes, load: Load | None, now: float) -> None:
        """Note that the replica has ended an attempt."""
        sent = self.at_work.pop(request, None)
        before, self.ended_at = self.ended_at, now
        self.doubted = False
        self._avoided_s = 0.0
        if sent is None:
            return
        begun, _, share = sent
        took_s, alone_s = now - begun, now - max(begun, before)
        slow = self.told >= NEW and alone_s > SLOW * self.alone_s
        self.slow_until = now + _SLOW_FOR * alone_s if slow else -NEVER
        if load is not None:
            rtt_s = max(0.0, took_s - load.spent_s)
            known = self._rtt_s
            if known is None or rtt_s < known:
                self._rtt_s = rtt_s
            else:
                self._rtt_s = known + _RTT_GAIN * (rtt_s - known)
        self._took(took_s, now, share)

    def dropped(self, request: bytes) -> None:
        """Note that an attempt has ended without the replica working on it."""
        self.at_work.pop(request, None)

    def failed(self, request: bytes, now: float) -> None:
        """Note a failed attempt that is its fault: failing fast does not count as quick."""
        self.at_work.pop(request, None)
        self._avoided_s = min(_AVOIDED_LIMIT_S, max(_AVOIDED_S, 2 * self._avoided_s))
        self._avoided_until = now + self._avoided_s

    def overtaken(self, request: bytes, begun: float, now: float) -> None:
        """Learn from a stopped attempt, if it was already unusually slow."""
        if now - begun >= self.delay_s:
            self._took(now - begun, now, self.at_work.get(request, (0.0, 0.0, 1.0))[2])

    def _took(self, seconds: float, now: float, share: float) -> None:
        self.latencies.add(seconds, now, share)
        samples = self.latencies.samples
        if samples >= self._delay_holds_until:  # with many, one more makes little difference
            self._delay_holds_until = samples + 1 + min(samples // 16, 15)
            self.delay_s = max(SHORTEST_DELAY_S, self.latencies.quantile_s(LATE_SHARE) or 0.0)
        if self._rtt_s is None:  # it has never reported its load
            self.service_s = self.usual_s = self.latencies.mean_below_s(LATE_SHARE) or 0.0

    def doubt(self, begun: float, now: float) -> bool:
        """Doubt it if an attempt is long overdue and none has ended since; return if doubted."""
        if self.ended_at < begun and now >= self.doubtful_at(begun):
            self.doubted = True
        return self.doubted

    def forget(self) -> None:
        """Note that its link is new or gone: nothing is in flight, and doubts are over."""
        self.at_work.clear()
        self.doubted = False
