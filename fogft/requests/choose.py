"""Hedging policies: which replicas get a request first, which next, and when. Pure.

A policy never sends anything. The dispatcher follows it, except for replicas that may not be asked
and requests that may have crashed a service (`pending`).

Owns: `all` and `failover`; the interface of every policy. Not here: `auto` (`requests.auto`),
which answer wins (`decide`).
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence, Set
from typing import Any

from fogft.requests.load import NEVER, Load, ReplicaLoad


class Choose:
    """A hedging policy. Not thread-safe: its owner holds a lock.

    Replicas are numbers. `open` maps each replica working on a request to when it was asked.
    A policy overrides only the methods it needs.
    """

    moves_on = True  # when no replica works on a request, another one is asked at once
    look_at = NEVER  # when to call `more` next if nothing else happens
    dear = False  # each further copy of the next request is expensive for an uplink
    news = False  # the policy has learned something about requests that are not due yet

    def first(self, request: bytes, able: Sequence[int], now: float) -> Sequence[int]:
        """Return the replicas, among those able, that a new request goes to at once."""
        raise NotImplementedError

    def more(
        self, request: bytes, open: Mapping[int, float], candidates: Sequence[int], now: float
    ) -> Sequence[int]:
        """Return the additional replicas to send an open request to now."""
        raise NotImplementedError

    def is_spare(self, request: bytes, replica: int) -> bool:
        """Whether the attempt is a spare copy, which the replica drops unless idle."""
        return False

    def too_busy(self, replica: int, within_s: float, now: float) -> bool:
        """Whether a request is expected to wait at the replica for longer than `within_s`."""
        return False

    def declined(self, request: bytes, replica: int, *, full: bool) -> None:
        """Note that a chosen replica was not asked: its window was full, or it was not needed."""

    def heard(self, request: bytes, replica: int, load: Load, now: float) -> None:
        """Take the load that a replica reports with the end of an attempt, which is noted next.

        If its answer ends the request, `answered` takes the load instead.
        """

    def answered(
        self, request: bytes, open: Mapping[int, float], replica: int, load: Load | None, now: float
    ) -> None:
        """Note that a replica has answered: the others are told to stop working on the request."""

    def failed(self, request: bytes, replica: int, now: float, *, fault: bool) -> None:
        """Note that an attempt ended without a valid answer; `fault` if the replica is to blame."""

    def late(self, request: bytes, replica: int, now: float, *, answered: bool) -> None:
        """Note that an attempt ended after its request; `answered` if the replica worked on it."""

    def stopped(
        self, request: bytes, open: Mapping[int, float], now: float, *, expired: bool = False
    ) -> None:
        """Note that a request ended before these attempts did, by deadline or otherwise."""

    def hangs(self, replica: int) -> None:
        """Note that a replica reports its service as hanging."""

    def forget(self, replica: int) -> None:
        """Note that a replica's link is new or gone: attempts in flight end without a report."""

    def keep(self, replicas: Set[int]) -> None:
        """Note that only these replicas exist: the others never come back."""

    def needed(self, able: Collection[int], now: float) -> int:
        """Return how many replicas would be enough if there are too few; else 0."""
        return 0

    def report(self) -> dict[str, Any]:
        """Return what the policy has learned, for people."""
        return {}


class All(Choose):
    """The policy `all`: every request goes to every replica, including those that join later."""

    moves_on = False  # all were asked already

    def first(self, request: bytes, able: Sequence[int], now: float) -> Sequence[int]:
        """Return every replica."""
        return able

    def more(
        self, request: bytes, open: Mapping[int, float], candidates: Sequence[int], now: float
    ) -> Sequence[int]:
        """Return every candidate: a replica working on the request may be frozen."""
        return candidates


class Learning(Choose):
    """A policy that learns how busy each replica is."""

    def __init__(self) -> None:
        self._replicas: defaultdict[int, ReplicaLoad] = defaultdict(ReplicaLoad)

    def too_busy(self, replica: int, within_s: float, now: float) -> bool:
        """Whether the expected wait exceeds `within_s`; False for a doubted replica (unknown)."""
        known = self._replicas[replica]
        return not known.doubted and known.wait_s(now) > within_s

    def answered(
        self, request: bytes, open: Mapping[int, float], replica: int, load: Load | None, now: float
    ) -> None:
        """Learn from the first response; the other attempts are learned from when they end."""
        self._replicas[replica].answered(request, load, now)

    def _doubts(self, replica: int, begun: float, now: float) -> bool:
        """Whether a replica is doubted, given an attempt that began at `begun`."""
        known = self._replicas[replica]
        self.news |= not known.doubted and known.doubt(begun, now)  # its other requests move, too
        return known.doubted

    def hangs(self, replica: int) -> None:
        """Doubt the replica: its requests go to others at once."""
        self._replicas[replica].doubted = self.news = True

    def forget(self, replica: int) -> None:
        """Forget attempts in flight to the replica."""
        self._replicas[replica].forget()

    def keep(self, replicas: Set[int]) -> None:
        """Forget what was learned about other replicas."""
        for replica in self._replicas.keys() - replicas:
            del self._replicas[replica]


class Failover(Learning):
    """The policy `failover`: one replica gets every request until it fails.

    While that replica answers nothing, long overdue and new requests go to another one as well.
    """

    def __init__(self) -> None:
        super().__init__()
        self._current: int | None = None
        self._failed = False  # the current one has failed: next time choose another, if any
        self.switched = 0
        self.hedges = 0

    def first(self, request: bytes, able: Sequence[int], now: float) -> Sequence[int]:
        """Return the current replica."""
        return self._asked(request, self._one_of(able), now)

    def more(
        self, request: bytes, open: Mapping[int, float], candidates: Sequence[int], now: float
    ) -> Sequence[int]:
        """Return another replica if none works on the request, or all that do are doubted."""
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
        # Round-robin, so that two failing replicas do not keep a third from being tried.
        self._current = next((o for o in others if old is not None and o > old), others[0])
        self._failed = False
        self.switched += old is not None
        return (self._current,)

    def declined(self, request: bytes, replica: int, *, full: bool) -> None:
        """Switch away from a replica whose window is full, or whose path is too slow."""
        self._replicas[replica].dropped(request)
        self._failed |= full and replica == self._current

    def failed(self, request: bytes, replica: int, now: float, *, fault: bool) -> None:
        """Switch away from a replica that failed."""
        self._replicas[replica].dropped(request)
        self._failed |= replica == self._current

    def late(self, request: bytes, replica: int, now: float, *, answered: bool) -> None:
        """Learn from an attempt that ended late; an answer ends any doubt about the replica."""
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
        """Switch away from the replica, with all its requests."""
        super().hangs(replica)
        self._failed |= replica == self._current

    def report(self) -> dict[str, Any]:
        """Return how often the current replica changed, and how many requests were hedged."""
        return {"switched": self.switched, "hedges": self.hedges}
