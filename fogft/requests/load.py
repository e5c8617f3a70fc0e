"""A replica's load, by its own report and by what one robot has sent. Pure.

Between two reports the robot counts what it sent itself. Several robots need no coordination: each
sees the others in the replica's words. Who is asked is decided in `auto` and `choose`.
"""

import math
from enum import IntFlag
from itertools import islice
from typing import NamedTuple

from fogft.requests.latency import Latencies

LATE_SHARE = 0.95
SHORTEST_DELAY_S = 0.001
UNKNOWN_DELAY_S = 0.1
_SAMPLES_NEEDED = 5  # with fewer, the 95 % quantile is but the longest one
_WORD_HOLDS_S = 1.0  # of a replica, about other robots' requests
_RTT_GAIN = 0.1
NEARLY = 0.8  # of what it usually takes
# Times as slow or quick as most: by less than the first, by what is known over a long time, no
# difference counts; by the second even one that is new does.
ALIKE, _ALIKE_LATELY = 1.7, 4.0
_USUAL_GAIN = 0.02
NEW = 20  # words of a replica: they say little
_FEW = 10  # answers: they do not show how it compares with others
# Of what a request is expected to take, and of what is ever at work:
_LATE, _STALLS = 1.2, 3.0
_DOUBT_AFTER = 2.0
_UNKNOWN_DOUBT_S = 2.0  # as long as it takes until a silent link is suspect
# A replica that fails is left alone: at first so long, then doubling, while another is able.
_AVOIDED_S = 0.1
_AVOIDED_LIMIT_S = 5.0
NEVER = float("inf")
_MANY = 16.0  # requests ahead: behind more, a time tells little of what is unusual
_FULL_OVER_S, _ASKED_OVER_S, _DEMAND_STEP_S = 10.0, 30.0, 0.1
# An answer that takes so many times as long as usual shows a slow spell of so many times that.
SLOW, _SLOW_FOR = 2.5, 5.0
_OFTEN = 0.5  # of the time something waits: there are too few replicas
_UNANSWERED = 1.15  # times what full ones answer is asked: no chance
_SILENT_S = 2.0  # without an answer nobody knows whether they are full
_TOO_FULL, _ENOUGH = 0.95, 0.8  # shares of what replicas can do: too much, and what they should do


class Handling(IntFlag):
    """How a replica should handle a request, besides running it."""

    NORMAL = 0
    DROP_IF_BUSY = 0x08  # a spare copy: drop it where it would have to wait
    ALONE = 0x10  # a service died while it worked on this: run nothing beside it


class Load(NamedTuple):  # made for each answer: a frozen dataclass costs thrice as much
    """The load of one service, reported by a replica with each answer and refusal."""

    waiting: int  # requests that wait for their turn
    running: int  # requests that the service has now
    slots: int  # how many it works on at once; 0 where that is not known yet
    service_s: float  # what it lately took for a request, divided by how many it had at once
    spent_s: float  # how long the request of this answer was at the replica


class Demand:
    """What robots ask of a service: this one, and all, as far as full replicas show it."""

    def __init__(self) -> None:
        self.full = False  # something waited at the replica that answered last
        self.rate = 0.0  # requests a second, lately; too few in the first seconds
        self._full_until = -NEVER  # unless another answer says so
        self._full_share = 0.0  # of the time, lately
        self._asked = 0.0  # lately
        self._asked_full = self._answered_full = 0.0  # while it was full, lately
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
        """Count an answer; no need where it was not full, and nothing waits."""
        self.full, self._full_until = load.waiting > 0, now + _SILENT_S
        self._answered_full += self.full

    def _kept(self, now: float, over_s: float) -> float:
        return math.exp((self._at - now) / over_s)

    def _share(self, now: float) -> float:
        kept, full = self._kept(now, _FULL_OVER_S), self.full and now < self._full_until
        return self._full_share * kept + (1.0 - kept) * full

    def replicas(self, able: int, service_s: float, now: float) -> int:
        """Return how many replicas would be enough, at `service_s` a request, if too few; else 0.

        Enough for this robot; and for all, where full replicas leave requests unanswered: they
        serve robots in turns, so those that ask as much see alike by how much they are too few.
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
        self.service_s = 0.0  # how long it lately worked on a request, as far as is known
        self.usual_s = 0.0  # the same, over a long time
        self.told = 0  # how often it has said so
        self.doubted = False  # an attempt is overdue, and it has ended none since that one began
        self.ended_at = -NEVER  # when it last ended an attempt, with an answer or too late for one
        self.asked_at = -NEVER
        self.slow_until = -NEVER  # its last answer took unusually long: another is preferred
        # Our attempts that it has not ended, oldest first: when each began, when it is overdue, and
        # for how much its time counts.
        self.at_work: dict[bytes, tuple[float, float, float]] = {}
        self.slots = 0
        self._rtt_s: float | None = None
        self._others = 0  # requests of other robots
        self._others_until = -NEVER
        self._avoided_s = 0.0
        self._avoided_until = -NEVER
        self.delay_s = UNKNOWN_DELAY_S  # after it an attempt takes unusually long
        self._delay_holds_until = _SAMPLES_NEEDED

    # -- what is believed -----------------------------------------------------------------

    @property
    def alone_s(self) -> float:
        """What an answer usually takes where nothing is ahead."""
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
        # One of ours that is nearly over: callers ask again as soon as the first has answered.
        one, takes_s = ahead == len(self.at_work) == 1, (self._rtt_s or 0.0) + self.service_s
        return one and NEARLY * takes_s <= self._spent_s(now) <= _LATE * takes_s

    def wait_s(self, now: float) -> float:
        """Return how long a request that arrives now is expected to wait: endless if in doubt."""
        if self.doubted:
            return NEVER
        if self.free(now):
            return 0.0
        return self.service_s * max(1, self.ahead(now) + 1 - max(1, self.slots))

    @property
    def oldest_begun(self) -> float:
        """When the oldest of our open requests there began; infinity for none."""
        for begun, _, _ in self.at_work.values():
            return begun
        return NEVER

    def _spent_s(self, now: float) -> float:
        """Return for how long it has been at the oldest of ours; 0 for none."""
        return now - max(self.oldest_begun, self.ended_at) if self.at_work else 0.0

    def avoided(self, now: float) -> bool:
        """Whether to prefer others: it is in doubt, or has failed."""
        return self.doubted or now < self._avoided_until

    def expected_s(self, now: float, typical_s: float, usual_s: float) -> float:
        """Return the expected latency of a request sent now.

        Round trip, and one service time for it and for each request before it, less what the one at
        work has had; one that takes far too long is taken to go on for as long again. A replica
        that is about as quick as most, or has hardly answered, is taken for equal: those take
        `typical_s` a request lately, `usual_s` over a long time.
        """
        service_s = self.service_s
        if self.latencies.samples < _FEW:
            service_s = typical_s or SHORTEST_DELAY_S  # of none known the fewest ahead count
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
            left_s -= min(spent_s, NEARLY * service_s)  # not as good as one that is idle
        elif spent_s > _STALLS * (rtt_s + service_s):
            left_s += spent_s
        return rtt_s + left_s

    def overdue_at(self, request: bytes, begun: float) -> float:
        """Return when an attempt is slower than nearly all others and than its expected wait."""
        return self.at_work.get(request, (0.0, begun + self.delay_s, 1.0))[1]

    def doubtful_at(self, begun: float) -> float:
        """Return when an attempt that began then is long overdue.

        Not as soon as it takes unusually long: one in twenty does. Of one that has answered little
        nothing is unusual for seconds.
        """
        if self.latencies.samples < _SAMPLES_NEEDED:
            return begun + _UNKNOWN_DOUBT_S
        return begun + _DOUBT_AFTER * self.delay_s

    # -- what happens ---------------------------------------------------------------------

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
        """Take its reported load, plus what was sent within the last round trip."""
        since = now - (self._rtt_s or 0.0)
        seen = len(self.at_work) - (request in self.at_work)
        for id, (begun, _, _) in reversed(self.at_work.items()):  # the newest first: few
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
        if seen > there:  # the ends of some were lost
            for lost in [*islice((id for id in self.at_work if id != request), seen - there)]:
                del self.at_work[lost]

    def answered(self, request: bytes, load: Load | None, now: float) -> None:
        """Note that it has ended an attempt."""
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
        """Note that an attempt failed by its fault: failing at once is not being quick."""
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
        if samples >= self._delay_holds_until:  # of many, one more makes little difference
            self._delay_holds_until = samples + 1 + min(samples // 16, 15)
            self.delay_s = max(SHORTEST_DELAY_S, self.latencies.quantile_s(LATE_SHARE) or 0.0)
        if self._rtt_s is None:  # it never told its load
            self.service_s = self.usual_s = self.latencies.mean_below_s(LATE_SHARE) or 0.0

    def doubt(self, begun: float, now: float) -> bool:
        """Doubt it if an attempt is long overdue and none has ended since; return whether it is."""
        if self.ended_at < begun and now >= self.doubtful_at(begun):
            self.doubted = True
        return self.doubted

    def forget(self) -> None:
        """Note that its link is new or gone: nothing is in flight, and doubts are over."""
        self.at_work.clear()
        self.doubted = False
