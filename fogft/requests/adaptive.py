"""Adaptive hedging: ask the best replica, and the next one when that takes unusually long. Pure.

* **Best** is who will answer first, going by the mean of its recent latencies, without the
  slowest 5 %: those are hedged. They were measured at its usual load; what is open there
  beyond that counts in proportion.
* **Unusually long** is longer than 95 % of that replica's recent answers. Then the next best
  is asked too, if the budget has a token.
* A replica with an attempt that takes unusually long, and no answer since that began, is
  **doubted**: new requests go elsewhere until it answers something. Without this a frozen
  replica would get every request for the two seconds until its link is suspect, and the
  budget would not last.
* When nobody works on a request (refused, link suspect, replica gone) the next best is asked
  at once. That replaces a copy, so it costs no token.
* A replica that was not asked for a while gets a copy of a request, a **probing copy**, which
  is left to finish so that its latency is learned. It costs a token, and leaves half of them.
  One of which little is known gets them sooner: one slow answer shall not banish it.

Law: copies <= requests + attempts that ended without an answer + capacity + share * requests.

Owns: estimates, delays and the budget of one service. Not here: sending (`proxy.robot.dispatcher`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from fogft.model.spec import HedgingMode, ServiceSpec
from fogft.requests.choose import NEVER, All, Choose, Failover
from fogft.requests.latency import Latencies

LATE_SHARE = 0.95
BUDGET_CAPACITY = 10.0
PROBE_EVERY_S = 10.0
SHORTEST_DELAY_S = 0.001
# With fewer samples the 95 % quantile is but the longest one, which must do.
_SAMPLES_NEEDED = 5
_SAMPLES_GOOD = 20
_PROBE_SOONER = 0.1
_UNKNOWN_DELAY_S = 0.1
_LOAD_GAIN = 0.05


class TokenBucket:
    """Tokens for extra copies: a share of what was asked for, and a little to begin with.

    Tokens come with requests, not with time: a service that is asked once a minute and one that is
    asked a thousand times a second both send the same share of extra copies.

    Law: after n requests at most ``capacity + share * n`` copies were taken.

    Args:
        share: Tokens that each request brings, above 0 and at most 1.
        capacity: The most that are kept, and how many there are at first.
    """

    def __init__(self, share: float, capacity: float) -> None:
        self._share = share
        self._capacity = capacity
        self._tokens = capacity

    @property
    def tokens(self) -> float:
        """What is there now."""
        return self._tokens

    def request(self) -> None:
        """Count a request."""
        self._tokens = min(self._capacity, self._tokens + self._share)

    def take(self, *, leave: float = 0.0) -> bool:
        """Take a token, if then at least `leave` are left."""
        if self._tokens < 1.0 + leave:
            return False
        self._tokens -= 1.0
        return True


class _Replica:
    """What is known of one replica."""

    __slots__ = ("answered_at", "asked_at", "doubted", "latencies", "load", "open")

    def __init__(self) -> None:
        self.latencies = Latencies()
        self.open = 0  # attempts
        self.load = 0.0  # attempts that were usually open besides one that was answered
        self.asked_at = -NEVER
        self.answered_at = -NEVER
        self.doubted = False

    def expected_s(self) -> float | None:
        """Return how long an answer would take; None where nothing is known."""
        mean_s = self.latencies.mean_below_s(LATE_SHARE)
        if mean_s is None:
            return None
        return mean_s * max(1.0, (self.open + 1) / (self.load + 1))

    def delay_s(self) -> float:
        """Return after how long an attempt takes unusually long."""
        if self.latencies.samples < _SAMPLES_NEEDED:
            return _UNKNOWN_DELAY_S
        delay_s = self.latencies.quantile_s(LATE_SHARE)
        return max(SHORTEST_DELAY_S, delay_s or 0.0)

    def ended(self) -> None:
        self.open = max(0, self.open - 1)


class Adaptive:
    """The policy `adaptive`; see `choose.Choose`.

    Args:
        budget: Extra copies that are allowed, as a share of requests.
        probe_every_s: A replica that was not asked for so long gets a probing copy, seconds.
    """

    moves_on = True

    def __init__(self, budget: float = 0.1, probe_every_s: float = PROBE_EVERY_S) -> None:
        self.look_at = NEVER
        self._probe_every_s = probe_every_s
        self._budget = TokenBucket(budget, BUDGET_CAPACITY)
        self._replicas: dict[int, _Replica] = {}
        self._probes: dict[tuple[bytes, int], float] = {}  # when each probing copy began
        self.hedges = 0
        self.probing = 0

    # -- choices --------------------------------------------------------------------------

    def first(self, request: bytes, able: Sequence[int], now: float) -> Sequence[int]:
        """Return the best, and now and then one that needs a probing copy besides."""
        self._budget.request()
        if not able:
            return ()
        best = self._best(able)
        chosen = [best]
        stale = self._stale(able, best, now)
        if stale is not None and self._budget.take(leave=BUDGET_CAPACITY / 2):
            self.probing += 1
            self._probes[request, stale] = now
            chosen.append(stale)
        for replica in chosen:
            self._asked(replica, now)
        if len(able) > len(chosen):
            self._look(now + self._replicas[best].delay_s())
        return chosen

    def more(
        self, open: Mapping[int, float], candidates: Sequence[int], now: float
    ) -> Sequence[int]:
        """Return the next best when those at work take unusually long, or there are none."""
        if not candidates:
            return ()
        if open:
            # Each further copy waits for the delay of the one before it.
            newest = max(open, key=open.__getitem__)
            due = open[newest] + self._of(newest).delay_s()
            if now < due:
                self._look(due)
                return ()
            self._doubt(open, now)
            if not self._budget.take():
                return ()
            self.hedges += 1
        best = self._best(candidates)
        self._asked(best, now)
        self._look(now + self._replicas[best].delay_s())
        return (best,)

    def _best(self, able: Sequence[int]) -> int:
        """Return who will answer first: unknown ones before all, doubted ones after all."""
        return min(able, key=self._rank)

    def _rank(self, replica: int) -> tuple[bool, float, int]:
        known = self._of(replica)
        expected_s = known.expected_s()
        # An unknown one: the more it was given already, the less it is tried.
        return (
            known.doubted,
            float(known.open) * 1e-9 if expected_s is None else expected_s,
            replica,
        )

    def _stale(self, able: Sequence[int], best: int, now: float) -> int | None:
        """Return the replica whose probing copy is longest due, if one is."""
        stalest, longest_s = None, 0.0
        for replica in able:
            known = self._of(replica)
            every_s = self._probe_every_s
            if known.latencies.samples < _SAMPLES_GOOD:
                every_s *= _PROBE_SOONER
            due_s = now - known.asked_at - every_s
            if replica != best and due_s >= longest_s:
                stalest, longest_s = replica, due_s
        return stalest

    def _doubt(self, open: Mapping[int, float], now: float) -> None:
        for replica, begun in open.items():
            known = self._of(replica)
            if known.answered_at < begun and now >= begun + known.delay_s():
                known.doubted = True

    def _of(self, replica: int) -> _Replica:
        known = self._replicas.get(replica)
        if known is None:
            known = self._replicas[replica] = _Replica()
        return known

    def _asked(self, replica: int, now: float) -> None:
        known = self._of(replica)
        known.open += 1
        known.asked_at = now

    def _look(self, at: float) -> None:
        self.look_at = min(self.look_at, at)

    # -- what became of them --------------------------------------------------------------

    def declined(self, replica: int, *, full: bool) -> None:
        """It was not asked. With a full window it is doubted, so that others are tried."""
        known = self._of(replica)
        known.ended()
        known.doubted = known.doubted or full

    def answered(
        self, request: bytes, open: Mapping[int, float], replica: int, now: float
    ) -> Iterable[int]:
        """Learn from the winner and the losers; all stop but a probing copy."""
        losers = []
        for other, begun in open.items():
            if (request, other) in self._probes:
                if other != replica:
                    continue  # it is awaited, and learned from when it comes
                del self._probes[request, other]
            known = self._of(other)
            known.ended()
            if other == replica:
                self._heard(known, now - begun, now)
                known.load += _LOAD_GAIN * (known.open - known.load)
            else:
                losers.append(other)
                self._overtaken(known, now - begun, now)
        return losers

    def _heard(self, known: _Replica, took_s: float, now: float) -> None:
        known.latencies.add(took_s, now)
        known.answered_at = now
        known.doubted = False

    def _overtaken(self, known: _Replica, waited_s: float, now: float) -> None:
        """Learn from an attempt that was stopped: it would have taken longer than this.

        Only if that is unusually long already; else it says nothing.
        """
        if waited_s >= known.delay_s():
            known.latencies.add(waited_s, now)

    def failed(self, request: bytes, replica: int, now: float) -> None:
        """An attempt ended without an answer."""
        self._of(replica).ended()
        self._probes.pop((request, replica), None)

    def awaits(self, request: bytes, replica: int) -> bool:
        """Whether it is a probing copy."""
        return (request, replica) in self._probes

    def late(self, request: bytes, replica: int, now: float, *, answered: bool) -> None:
        """Learn from a probing copy that was not the first."""
        begun = self._probes.pop((request, replica), None)
        if begun is None:
            return
        known = self._of(replica)
        known.ended()
        if answered:
            self._heard(known, now - begun, now)

    def stopped(
        self, request: bytes, open: Mapping[int, float], now: float, *, expired: bool = False
    ) -> None:
        """Learn that these would have taken longer than until now.

        At a deadline, who has answered nothing else meanwhile is doubted.
        """
        for replica, begun in open.items():
            self._probes.pop((request, replica), None)
            known = self._of(replica)
            known.ended()
            self._overtaken(known, now - begun, now)
            known.doubted = known.doubted or (expired and known.answered_at < begun)

    def report(self) -> dict[str, Any]:
        """Return counts, the budget, and each replica's estimate by ``slot.generation``."""
        return {
            "hedges": self.hedges,
            "probing": self.probing,
            "tokens": self._budget.tokens,
            "replicas": {
                f"{replica >> 32}.{replica & 0xFFFFFFFF}": {
                    "mean_s": known.latencies.mean_below_s(LATE_SHARE),
                    "delay_s": known.delay_s(),
                    "open": known.open,
                    "doubted": known.doubted,
                }
                for replica, known in sorted(self._replicas.items())
            },
        }


def policy(spec: ServiceSpec) -> Choose:
    """Return what chooses for a service, as its `hedging` says."""
    if spec.hedging is HedgingMode.ADAPTIVE:
        return Adaptive(spec.hedging_budget)
    return Failover() if spec.hedging is HedgingMode.FAILOVER else All()
