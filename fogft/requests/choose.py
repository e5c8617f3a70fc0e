"""Hedging policies: which replicas get a request first, which next, and when. Pure.

A policy never sends anything; the dispatcher does as it says, but for replicas that may not be
asked, and requests that may have ended a service (`pending`).

Owns: `all` and `failover`; the interface of every policy. Not here: `auto` (`requests.auto`),
which answer wins (`decide`).
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence, Set
from typing import Any

from fogft.requests.load import NEVER, Load, ReplicaLoad


class Choose:
    """A hedging policy. Not thread-safe: its owner holds a lock.

    Replicas are numbers, `open` maps each that works on a request to the moment it was asked.
    What a policy does not say here it does not care for.
    """

    moves_on = True  # another replica is asked at once when nobody works on a request
    look_at = NEVER  # when `more` wants to be asked next, though nothing else has happened
    dear = False  # each further copy of the next request costs an uplink much
    news = False  # it has learned something about requests that were not due yet

    def first(self, request: bytes, able: Sequence[int], now: float) -> Sequence[int]:
        """Return the replicas, of those able, that a new request goes to at once."""
        raise NotImplementedError

    def more(
        self, request: bytes, open: Mapping[int, float], candidates: Sequence[int], now: float
    ) -> Sequence[int]:
        """Return the further replicas that an open request goes to now."""
        raise NotImplementedError

    def is_spare(self, request: bytes, replica: int) -> bool:
        """Whether the replica drops an attempt unless idle."""
        return False

    def too_busy(self, replica: int, within_s: float, now: float) -> bool:
        """Whether a request is expected to wait there for longer than that."""
        return False

    def declined(self, request: bytes, replica: int, *, full: bool) -> None:
        """Note that a chosen replica was not asked: its window was full, or there was no need."""

    def heard(self, request: bytes, replica: int, load: Load, now: float) -> None:
        """Take the load that a replica tells with the end of an attempt, which is noted next.

        But for an answer that ends its request: `answered` takes that one's load.
        """

    def answered(
        self, request: bytes, open: Mapping[int, float], replica: int, load: Load | None, now: float
    ) -> None:
        """Note that a replica has answered: the others are to stop working on the request."""

    def failed(self, request: bytes, replica: int, now: float, *, fault: bool) -> None:
        """Note that an attempt ended without a valid answer, by the replica's fault or not."""

    def late(self, request: bytes, replica: int, now: float, *, answered: bool) -> None:
        """Note that an attempt ended after its request, with or without work on it."""

    def stopped(
        self, request: bytes, open: Mapping[int, float], now: float, *, expired: bool = False
    ) -> None:
        """Note that a request ended without these attempts, by deadline or otherwise."""

    def hangs(self, replica: int) -> None:
        """Note that a replica reports its service as hanging."""

    def forget(self, replica: int) -> None:
        """Note that a replica's link is new or gone: attempts in flight end without a report."""

    def keep(self, replicas: Set[int]) -> None:
        """Note that there are only these replicas: none of the others comes back."""

    def needed(self, able: Collection[int], now: float) -> int:
        """Return how many replicas would be enough if there are too few; else 0."""
        return 0

    def report(self) -> dict[str, Any]:
        """Return what the policy has learned, for people."""
        return {}


class All(Choose):
    """The policy `all`: every request goes to every replica, later ones included."""

    moves_on = False  # all were asked already

    def first(self, request: bytes, able: Sequence[int], now: float) -> Sequence[int]:
        """Return all of them."""
        return able

    def more(
        self, request: bytes, open: Mapping[int, float], candidates: Sequence[int], now: float
    ) -> Sequence[int]:
        """Return all of them: a replica at work on the request may be frozen."""
        return candidates


class Learning(Choose):
    """A policy that learns how busy each replica is."""

    def __init__(self) -> None:
        self._replicas: defaultdict[int, ReplicaLoad] = defaultdict(ReplicaLoad)

    def too_busy(self, replica: int, within_s: float, now: float) -> bool:
        """Whether what is before a request there takes longer; of one in doubt nobody knows."""
        known = self._replicas[replica]
        return not known.doubted and known.wait_s(now) > within_s

    def answered(
        self, request: bytes, open: Mapping[int, float], replica: int, load: Load | None, now: float
    ) -> None:
        """Learn from the first response; the others stop, and are learned from when they end."""
        self._replicas[replica].answered(request, load, now)

    def _doubts(self, replica: int, begun: float, now: float) -> bool:
        """Whether a replica is doubted, by an attempt that began then."""
        known = self._replicas[replica]
        self.news |= not known.doubted and known.doubt(begun, now)  # what else it has moves, too
        return known.doubted

    def hangs(self, replica: int) -> None:
        """Doubt it: its requests go to others at once."""
        self._replicas[replica].doubted = self.news = True

    def forget(self, replica: int) -> None:
        """Forget attempts in flight to it."""
        self._replicas[replica].forget()

    def keep(self, replicas: Set[int]) -> None:
        """Forget what was learned of others."""
        for replica in self._replicas.keys() - replicas:
            del self._replicas[replica]


class Failover(Learning):
    """The policy `failover`: one replica gets every request until it fails.

    While it answers nothing, requests that are long overdue, and new ones, go to another as well.
    """

    def __init__(self) -> None:
        super().__init__()
        self._current: int | None = None
        self._failed = False  # the present one has: the next choice is another, if there is one
        self.switched = 0
        self.hedges = 0

    def first(self, request: bytes, able: Sequence[int], now: float) -> Sequence[int]:
        """Return the current replica."""
        return self._asked(request, self._one_of(able), now)

    def more(
        self, request: bytes, open: Mapping[int, float], candidates: Sequence[int], now: float
    ) -> Sequence[int]:
        """Return another replica if none works on the request, or seems to."""
        if not candidates:
            return ()
        for replica, begun in open.items():
            if not self._doubts(replica, begun, now):
                overdue_at = self._replicas[replica].doubtful_at(begun)
                if now < overdue_at:
                    self.look_at = min(self.look_at, overdue_at)
                return ()
        self.hedges += bool(open)
        self._failed |= self._current in open
        return self._asked(request, self._one_of(candidates), now)

    def _asked(self, request: bytes, chosen: Sequence[int], now: float) -> Sequence[int]:
        for replica in chosen:
            known = self._replicas[replica]
            known.asked(request, now)
            self.look_at = min(self.look_at, known.doubtful_at(now))
        return chosen

    def _one_of(self, able: Sequence[int]) -> Sequence[int]:
        old = self._current
        if old is not None and old in able and not self._failed:
            return (old,)
        others = [replica for replica in able if replica != old]
        if not others:
            return able  # none, or the one that failed
        # In turns, so that two that fail do not keep a third from being tried.
        self._current = next((o for o in others if old is not None and o > old), others[0])
        self._failed = False
        self.switched += old is not None
        return (self._current,)

    def declined(self, request: bytes, replica: int, *, full: bool) -> None:
        """Switch away from a replica that has no room, or too slow a path."""
        self._replicas[replica].dropped(request)
        self._failed |= full and replica == self._current

    def failed(self, request: bytes, replica: int, now: float, *, fault: bool) -> None:
        """Switch away from a replica that failed."""
        self._replicas[replica].dropped(request)
        self._failed |= replica == self._current

    def late(self, request: bytes, replica: int, now: float, *, answered: bool) -> None:
        """Note that it works again."""
        if answered:
            self._replicas[replica].answered(request, None, now)
        else:
            self._replicas[replica].dropped(request)

    def stopped(
        self, request: bytes, open: Mapping[int, float], now: float, *, expired: bool = False
    ) -> None:
        """Switch away from a replica that missed a deadline: its service may hang."""
        self._failed |= expired and self._current in open

    def hangs(self, replica: int) -> None:
        """Switch away from it, with all its requests."""
        super().hangs(replica)
        self._failed |= replica == self._current

    def report(self) -> dict[str, Any]:
        """Return how often the replica changed, and how often another was asked as well."""
        return {"switched": self.switched, "hedges": self.hedges}
