"""Hedging by load: a request goes to every replica while they are idle, to one when busy. Pure.

First copies, spare copies, late hedges and doubt: docs/design/hedging.md.

Laws: every request has a copy that is not a spare; late hedges <= capacity + share * requests.

Not here: the load estimate of a replica (`load`), sending (`proxy.robot.sending`).
"""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from fogft.model.replica import short
from fogft.requests.choose import Learning
from fogft.requests.load import ALIKE, NEVER, SLOW, Demand, Load

BUDGET_SHARE, BUDGET_CAPACITY = 0.1, 10.0  # token bucket of late hedges: per request, at most
_TRIAL_EVERY_S = 10.0  # a replica that was not asked for this long gets a spare copy
_SLOW_TRIAL_EVERY = 20.0  # the same for a slower replica, in its own service times
_DOUBTED_TRIAL_EVERY_S = 1.0
# The balance of spare copies, in service times:
_REMEMBERED = 1000.0  # decay time of what they saved and cost
_REMEMBERED_MOST = 10.0  # cap on the net saving
_MATTERS = 0.5  # a balance beyond this changes the number of spare copies
_TRIED_AFTER = 3000.0  # this long after a change, one more spare copy is tried
_WAIT = 0.6  # cost of making a request wait for a spare copy
_TRIED_SHARE = 0.02  # share of requests that try one more spare copy meanwhile
_RETRY_S = 0.02
_BUSY = 0.4  # utilization above which spare copies would make requests wait


class Spares:
    """How many idle replicas spare copies leave free: the more waiting they cause, the more."""

    def __init__(self) -> None:
        self.left_free = 0
        self._balance_s = 0.0  # time saved by spare copies, less the waiting they caused
        self._at = self._changed_at = 0.0
        self.open: dict[tuple[bytes, int], float] = {}  # unfinished spare copies, and when sent

    def request(self, service_s: float, replicas: int, now: float) -> None:
        """Note a request: decay the balance and adjust how many replicas are left free."""
        service_s = max(service_s, 1e-4)
        self._balance_s *= math.exp((self._at - now) / (_REMEMBERED * service_s))
        self._balance_s = min(self._balance_s, _REMEMBERED_MOST * service_s)
        self._at = now
        if self._balance_s < -_MATTERS * service_s:
            self._change(min(self.left_free + 1, replicas - 1), now)
        elif self.left_free and self._balance_s > _MATTERS * service_s:
            self.left_free -= 1
            self._changed_at = now
        elif self.left_free and now > self._changed_at + _TRIED_AFTER * service_s:
            self._change(self.left_free - 1, now)

    def _change(self, left_free: int, now: float) -> None:
        self.left_free, self._changed_at, self._balance_s = left_free, now, 0.0

    def left_free_by(self, request: bytes) -> int:
        """Return how many replicas a request leaves free; some, by random id, try one fewer."""
        tries = int.from_bytes(request[:2], "big") < _TRIED_SHARE * 65536
        return self.left_free - (tries and self.left_free > 0)

    def saved(self, seconds: float) -> None:
        """Note seconds that a spare copy saved; negative for time that a request waits for one."""
        self._balance_s += seconds


class Auto(Learning):
    """The policy `auto`; see `choose.Choose`."""

    def __init__(self) -> None:
        super().__init__()
        self._tokens = BUDGET_CAPACITY  # for late hedges; each request adds a fraction of one
        self._spares = Spares()
        self._demand = Demand()
        self._busy = False
        self._slow_until = -NEVER  # at least one replica is in a slow spell until then
        self._beaten: dict[tuple[bytes, int], float] = {}  # first copies, and when a spare won
        self._wanting: dict[bytes, None] = {}  # requests that get a spare once a replica is free
        self.hedges = 0

    # -- choices --------------------------------------------------------------------------

    def first(self, request: bytes, able: Sequence[int], now: float) -> Sequence[int]:
        """Return the replica expected to answer first, then idle ones for spare copies."""
        self._tokens = min(BUDGET_CAPACITY, self._tokens + BUDGET_SHARE)
        self._demand.asked(now)
        if not able:
            return ()
        for replica in able:  # `more` does not see its attempts at requests answered by others
            known = self._replicas[replica]
            if known.at_work and known.ended_at < known.oldest_begun:
                self._doubts(replica, known.oldest_begun, now)
        quick = self._quick(able, now) if now < self._slow_until and not self._busy else able
        best = self._best(request, quick, now)
        known = self._replicas[best]
        if len(able) == 1:
            known.asked(request, now)
            return able  # there is no other replica to hedge at
        self._busy = known.slots <= 1 and self._demand.rate * known.service_s > _BUSY * len(able)
        self._spares.request(known.service_s, len(able), now)
        if self._spares.open and not known.free(now):
            self._spares.saved(-_WAIT * known.service_s)
        overdue_at = known.asked(request, now)
        left_free = self._spares.left_free_by(request)
        copied = left_free < len(able) - 1 and not self.dear and not self._busy
        others = able if copied else self._stale(able, best, now)
        spares = [other for other in others if other != best and self._takes_spare(other, now)]
        if copied and left_free:
            spares = spares[:-left_free]
        elif len(spares) + 1 < len(others):
            self._wanting[request] = None
        if len(spares) + 1 < len(able):  # else there is no other replica to hedge at
            self._look(overdue_at)
        return [best, *self._spared(request, spares, now)] if spares else [best]

    def _spared(self, request: bytes, replicas: Sequence[int], now: float) -> Sequence[int]:
        for replica in replicas:
            self._spares.open[request, replica] = now
            self._replicas[replica].asked(request, now, spare=True)
        return replicas

    def _takes_spare(self, replica: int, now: float) -> bool:
        known = self._replicas[replica]
        return known.free(now) or (known.doubted and now - known.asked_at >= _DOUBTED_TRIAL_EVERY_S)

    def _quick(self, able: Sequence[int], now: float) -> Sequence[int]:
        """Return the replicas neither avoided nor slow now, if one of them is free; else all."""
        known = self._replicas
        sound = [r for r in able if not known[r].avoided(now)]
        most_s = SLOW * min((known[r].alone_s for r in sound if known[r].told), default=0.0)
        quick = [r for r in sound if now >= known[r].slow_until and known[r].alone_s <= most_s]
        return quick if any(known[r].free(now) for r in quick) else able

    def _stale(self, able: Sequence[int], best: int, now: float) -> list[int]:
        """Return replicas not asked for long, or doubted: a spare copy refreshes their estimate."""
        stale, slower_s = [], NEVER if self.dear else ALIKE * self._replicas[best].usual_s
        for replica in able:
            known = self._replicas[replica]
            often_s = _SLOW_TRIAL_EVERY * known.usual_s if known.usual_s > slower_s else NEVER
            every_s = min(_TRIAL_EVERY_S, often_s)
            if known.doubted or known.asked_at <= now - every_s:
                stale.append(replica)
        return stale

    def more(
        self, request: bytes, open: Mapping[int, float], candidates: Sequence[int], now: float
    ) -> Sequence[int]:
        """Return the next best replica if no attempt is open or all are unusually slow."""
        if not candidates:
            return ()
        if open:
            free = [c for c in candidates if self._replicas[c].free(now)]
            if free and request in self._wanting:
                return self._spared(request, free, now)
            doubted = [self._doubts(replica, begun, now) for replica, begun in open.items()]
            if not all(doubted):  # a replica is working on it: hedge only at a free one, in budget
                due = max(self._replicas[r].overdue_at(request, begun) for r, begun in open.items())
                if now < due:
                    self._look(due)
                    return ()
                free = [c for c in free if now >= self._replicas[c].slow_until]
                if not free or self._tokens < 1.0:
                    self._look(now + _RETRY_S)
                    return ()
                self._tokens -= 1.0
                candidates = free
                self.hedges += 1
            else:
                wait_s = min(self._replicas[c].wait_s(now) for c in candidates)
                longer_s = wait_s - (now - min(open.values()))
                if longer_s > 0.0:  # than the wait so far: look again after half the difference
                    self._look(now + max(_RETRY_S, longer_s / 2))
                    return ()
        best = self._best(request, candidates, now)
        self._look(self._replicas[best].asked(request, now))
        return (best,)

    def _best(self, request: bytes, able: Sequence[int], now: float) -> int:
        """Return the replica expected to answer first; ties are broken by the random request id."""
        if len(able) == 1:
            return able[0]
        known = [self._replicas[replica] for replica in able]
        middle = len(known) // 2
        typical_s = sorted([one.service_s for one in known])[middle]
        usual_s = sorted([one.usual_s for one in known])[middle]
        ranks = [(one.avoided(now), one.expected_s(now, typical_s, usual_s)) for one in known]
        least = min(ranks)
        equals = ranks.count(least)
        if equals == 1:
            return able[ranks.index(least)]
        chance = int.from_bytes(request[-4:], "big") % equals
        return [one for one, rank in zip(able, ranks, strict=True) if rank == least][chance]

    def is_spare(self, request: bytes, replica: int) -> bool:
        """Whether the replica should drop the attempt unless idle."""
        return (request, replica) in self._spares.open

    def _look(self, at: float) -> None:
        self.look_at = min(self.look_at, at)

    # -- outcomes -------------------------------------------------------------------------

    def declined(self, request: bytes, replica: int, *, full: bool) -> None:
        """Note that a replica was not asked. If its window was full, doubt it: try others."""
        self._spares.open.pop((request, replica), None)
        known = self._replicas[replica]
        known.dropped(request)
        known.doubted = known.doubted or full

    def heard(self, request: bytes, replica: int, load: Load, now: float) -> None:
        """Take a replica's reported load."""
        self._replicas[replica].heard(request, load, now)

    def answered(
        self, request: bytes, open: Mapping[int, float], replica: int, load: Load | None, now: float
    ) -> None:
        """Learn from the first response, also whether it was a spare copy's and who is free now."""
        self._wanting.pop(request, None)
        if self._spares.open.pop((request, replica), None) is not None:
            for other in open:
                if other != replica and not self.is_spare(request, other):
                    self._beaten[request, other] = now
        known = self._replicas[replica]
        if load is not None:
            known.heard(request, load, now)
            if load.waiting or self._demand.full:
                self._demand.answered(load, now)
        known.answered(request, load, now)
        self._released(replica, now)

    def failed(self, request: bytes, replica: int, now: float, *, fault: bool) -> None:
        """Note that an attempt ended without an answer."""
        self._wanting.pop(request, None)
        self._spares.open.pop((request, replica), None)
        if fault:
            self._replicas[replica].failed(request, now)
        else:
            self._replicas[replica].dropped(request)

    def late(self, request: bytes, replica: int, now: float, *, answered: bool) -> None:
        """Learn from an attempt that ended after its request."""
        self._spares.open.pop((request, replica), None)
        beaten = self._beaten.pop((request, replica), now)
        if answered:
            self._spares.saved(now - beaten)
            self._replicas[replica].answered(request, None, now)
        else:
            self._replicas[replica].dropped(request)
        self._released(replica, now)

    def _released(self, replica: int, now: float) -> None:
        """Have a newly free replica get a spare copy of a waiting request, if there is one."""
        known = self._replicas[replica]
        self._slow_until = max(self._slow_until, known.slow_until)
        self.news |= bool(self._wanting) and known.free(now)

    def stopped(
        self, request: bytes, open: Mapping[int, float], now: float, *, expired: bool = False
    ) -> None:
        """Learn that these attempts would have taken longer than they have so far."""
        self._wanting.pop(request, None)
        for replica, begun in open.items():
            known = self._replicas[replica]
            known.overtaken(request, begun, now)
            if expired:
                known.doubt(begun, now)

    def forget(self, replica: int) -> None:
        """Forget attempts in flight to the replica."""
        super().forget(replica)
        for copies in (self._spares.open, self._beaten):
            for key in [key for key in copies if key[1] == replica]:
                del copies[key]

    def needed(self, able: Collection[int], now: float) -> int:
        """Return how many replicas would be enough if there are too few; else 0."""
        times_s = sorted(t for r in able if (t := self._replicas[r].service_s))
        typical_s = times_s[len(times_s) // 2] if times_s else 0.0
        return self._demand.replicas(len(able), typical_s, now)

    def report(self) -> dict[str, Any]:
        """Return counts, the budget, and each replica's estimate by ``slot.generation``."""
        return {
            "hedges": self.hedges,
            "left_free": self._spares.left_free,
            "tokens": self._tokens,
            "replicas": {
                short(replica): {
                    "service_s": known.service_s,
                    "delay_s": known.delay_s,
                    "doubted": known.doubted,
                }
                for replica, known in sorted(self._replicas.items())
            },
        }
