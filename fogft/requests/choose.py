"""Choose which replicas a request goes to first, which next, and when. Pure: time comes in.

A policy is asked when a request comes (`first`) and again while it is open (`more`), and is
told how each attempt ended. It never sends anything; the dispatcher does as it says, but for
replicas that may not be asked, and requests that may have ended a service (`pending`).

Owns: `all` and `failover`; the interface of every policy.
Not here: `auto`, and which policy a service has (`fogft.requests.auto`), which answer wins
(`fogft.requests.decide`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from fogft.requests.load import NEVER, Load, ReplicaLoad


class Choose:
    """Decides which replicas work on a request. Not thread-safe: its owner holds a lock.

    Replicas are numbers, `open` maps each that works on a request to the moment it was asked.
    What a policy does not say here it does not care for.

    Attributes:
        look_at: When `more` wants to be asked next, though nothing else has happened.
        news: What it has learned concerns requests that it did not want to be asked about yet.
    """

    moves_on = True
    look_at = NEVER
    news = False

    def first(self, request: bytes, able: Sequence[int], now: float) -> Sequence[int]:
        """Return which of the able replicas a new request goes to at once."""
        raise NotImplementedError

    def more(
        self, request: bytes, open: Mapping[int, float], candidates: Sequence[int], now: float
    ) -> Sequence[int]:
        """Return which of those that may be asked, and are not, an open request goes to now."""
        raise NotImplementedError

    def is_spare(self, request: bytes, replica: int) -> bool:
        """Whether an attempt is one that the replica drops unless it has nothing else to do."""
        return False

    def declined(self, request: bytes, replica: int, *, full: bool) -> None:
        """A replica that was returned was not asked: its window was full, or no need was left."""

    def heard(self, request: bytes, replica: int, load: Load, now: float) -> None:
        """A replica has told its load, with the end of this attempt, which is told next."""

    def answered(
        self, request: bytes, open: Mapping[int, float], replica: int, load: Load | None, now: float
    ) -> Iterable[int]:
        """A replica has answered a request; return who shall stop working on it."""
        return [other for other in open if other != replica] if len(open) > 1 else ()

    def failed(self, request: bytes, replica: int, now: float, *, fault: bool) -> None:
        """An attempt ended without an answer that counts, by the replica's fault or without."""

    def late(self, request: bytes, replica: int, now: float, *, answered: bool) -> None:
        """An attempt ended after its request had: the replica has worked on it, or it has not."""

    def stopped(
        self, request: bytes, open: Mapping[int, float], now: float, *, expired: bool = False
    ) -> None:
        """A request ended without these: its deadline came, or it was answered otherwise."""

    def hangs(self, replica: int) -> None:
        """A replica has told that its service answers nothing of what it has."""

    def forget(self, replica: int) -> None:
        """A replica's link is new, or gone: of what was on the way there nothing more is heard."""

    def needed(self, able: int, now: float) -> int:
        """Return how many replicas would do, where those able are too few; else 0."""
        return 0

    def report(self) -> dict[str, Any]:
        """Return what the policy has learned, for people."""
        return {}


class All(Choose):
    """Every request goes to every replica at once, and to all that come later. Learns nothing."""

    moves_on = False  # all were asked already

    def first(self, request: bytes, able: Sequence[int], now: float) -> Sequence[int]:
        """Return all of them."""
        return able

    def more(
        self, request: bytes, open: Mapping[int, float], candidates: Sequence[int], now: float
    ) -> Sequence[int]:
        """Return all of them: whoever works on the request may be frozen."""
        return candidates


class Learning(Choose):
    """A policy that learns how busy each replica is, by what it answers."""

    def __init__(self) -> None:
        self._replicas: defaultdict[int, ReplicaLoad] = defaultdict(ReplicaLoad)

    def answered(
        self, request: bytes, open: Mapping[int, float], replica: int, load: Load | None, now: float
    ) -> Iterable[int]:
        """Learn from the winner; the others stop, and are learned from when they end."""
        self._replicas[replica].answered(request, load, now)
        return super().answered(request, open, replica, load, now)

    def _doubts(self, replica: int, begun: float, now: float) -> bool:
        """Whether a replica is doubted, by an attempt that began then."""
        known = self._replicas[replica]
        was = known.doubted
        if known.doubt(begun, now) and not was:
            self.news = True  # what else it has goes to another, too
        return known.doubted

    def hangs(self, replica: int) -> None:
        """Doubt it: what it has goes to others at once."""
        self._replicas[replica].doubted = self.news = True

    def forget(self, replica: int) -> None:
        """Forget what was on the way there."""
        self._replicas[replica].forget()


class Failover(Learning):
    """One replica gets every request. Another one takes its place when it fails.

    It fails when it is no longer able to answer (suspected, not ready, drained), when an
    attempt of its ends without an answer, and when it lets a deadline pass. A request that takes
    unusually long, while the one has answered nothing since, goes to another as well, and so do
    those that come until it answers.
    """

    def __init__(self) -> None:
        super().__init__()
        self._current: int | None = None
        self._failed = False  # the present one has: the next choice is another, if there is one
        self.switched = 0
        self.hedges = 0

    def first(self, request: bytes, able: Sequence[int], now: float) -> Sequence[int]:
        """Return the one."""
        return self._asked(request, self._one_of(able), now)

    def more(
        self, request: bytes, open: Mapping[int, float], candidates: Sequence[int], now: float
    ) -> Sequence[int]:
        """Return one when nobody works on the request, or nobody seems to."""
        if not candidates:
            return ()
        for replica, begun in open.items():
            if not self._doubts(replica, begun, now):
                overdue_at = self._replicas[replica].doubtful_at(begun)
                if now < overdue_at:
                    self.look_at = min(self.look_at, overdue_at)
                return ()
        self.hedges += bool(open)
        self._failed = self._failed or self._current in open
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
        """Stay: a full window is no failure."""
        self._replicas[replica].dropped(request)

    def failed(self, request: bytes, replica: int, now: float, *, fault: bool) -> None:
        """Move on from a replica that failed."""
        self._replicas[replica].dropped(request)
        if replica == self._current:
            self._failed = True

    def late(self, request: bytes, replica: int, now: float, *, answered: bool) -> None:
        """Learn that it works again."""
        if answered:
            self._replicas[replica].answered(request, None, now)
        else:
            self._replicas[replica].dropped(request)

    def stopped(
        self, request: bytes, open: Mapping[int, float], now: float, *, expired: bool = False
    ) -> None:
        """Move on from a replica that let a deadline pass: its service may hang."""
        if expired and self._current in open:
            self._failed = True

    def hangs(self, replica: int) -> None:
        """Move on from it, with all that it has."""
        super().hangs(replica)
        if replica == self._current:
            self._failed = True

    def report(self) -> dict[str, Any]:
        """Return how often the replica changed, and how often another was asked as well."""
        return {"switched": self.switched, "hedges": self.hedges}
