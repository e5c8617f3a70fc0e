"""Choose which replicas a request goes to first, which next, and when. Pure: time comes in.

A policy is asked when a request comes (`first`) and again while it is open (`more`), and is
told how each attempt ended. It never sends anything; the dispatcher does as it says, and
checks nothing but that a replica may be asked.

Owns: `all` and `failover`; the interface of every policy.
Not here: `adaptive` (`fogft.requests.adaptive`), which answer wins (`fogft.requests.decide`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol

NEVER = float("inf")


class Choose(Protocol):
    """Decides which replicas work on a request. Not thread-safe: its owner holds a lock.

    Replicas are numbers, `open` maps each that works on a request to the moment it was asked.

    Attributes:
        moves_on: Whether another replica is asked at once when nobody works on a request.
        look_at: When `more` wants to be asked next, though nothing else has happened.
    """

    moves_on: bool
    look_at: float

    def first(self, request: bytes, able: Sequence[int], now: float) -> Sequence[int]:
        """Return which of the able replicas a new request goes to at once."""

    def more(
        self, open: Mapping[int, float], candidates: Sequence[int], now: float
    ) -> Sequence[int]:
        """Return which of those that may be asked, and are not, an open request goes to now."""

    def declined(self, replica: int, *, full: bool) -> None:
        """A replica that was returned was not asked: its window was full, or no need was left."""

    def answered(
        self, request: bytes, open: Mapping[int, float], replica: int, now: float
    ) -> Iterable[int]:
        """A replica has answered a request; return who shall stop working on it."""

    def failed(self, request: bytes, replica: int, now: float) -> None:
        """An attempt ended without an answer that counts."""

    def awaits(self, request: bytes, replica: int) -> bool:
        """Whether an answer shall come, though another one was first."""

    def late(self, request: bytes, replica: int, now: float, *, answered: bool) -> None:
        """An attempt ended after its request had: with an answer, or without one."""

    def stopped(
        self, request: bytes, open: Mapping[int, float], now: float, *, expired: bool = False
    ) -> None:
        """A request ended without these: its deadline came, or it was answered otherwise."""

    def report(self) -> dict[str, Any]:
        """Return what the policy has learned, for people."""


class All:
    """Every request goes to every replica at once, and to all that come later. Learns nothing."""

    moves_on = False  # all were asked already
    look_at = NEVER

    def first(self, request: bytes, able: Sequence[int], now: float) -> Sequence[int]:
        """Return all of them."""
        return able

    def more(
        self, open: Mapping[int, float], candidates: Sequence[int], now: float
    ) -> Sequence[int]:
        """Return all of them: whoever works on the request may be frozen."""
        return candidates

    def declined(self, replica: int, *, full: bool) -> None:
        """Learn nothing."""

    def answered(
        self, request: bytes, open: Mapping[int, float], replica: int, now: float
    ) -> Iterable[int]:
        """Return all others."""
        if len(open) == 1:
            return ()
        return [other for other in open if other != replica]

    def failed(self, request: bytes, replica: int, now: float) -> None:
        """Learn nothing."""

    def awaits(self, request: bytes, replica: int) -> bool:
        """Await nothing."""
        return False

    def late(self, request: bytes, replica: int, now: float, *, answered: bool) -> None:
        """Learn nothing."""

    def stopped(
        self, request: bytes, open: Mapping[int, float], now: float, *, expired: bool = False
    ) -> None:
        """Learn nothing."""

    def report(self) -> dict[str, Any]:
        """Return nothing."""
        return {}


class Failover:
    """One replica gets every request. Another one takes its place when it fails.

    It fails when it is no longer able to answer (suspected, not ready, drained), when an
    attempt of its ends without an answer, and when it lets a deadline pass.
    """

    moves_on = True
    look_at = NEVER

    def __init__(self) -> None:
        self._current: int | None = None
        self._failed = False  # the present one has: the next choice is another, if there is one
        self.switched = 0

    def first(self, request: bytes, able: Sequence[int], now: float) -> Sequence[int]:
        """Return the one."""
        return self._one_of(able)

    def more(
        self, open: Mapping[int, float], candidates: Sequence[int], now: float
    ) -> Sequence[int]:
        """Return one when nobody works on the request: the present one, or the next."""
        return () if open else self._one_of(candidates)

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

    def declined(self, replica: int, *, full: bool) -> None:
        """Stay: a full window is no failure."""

    def answered(
        self, request: bytes, open: Mapping[int, float], replica: int, now: float
    ) -> Iterable[int]:
        """Return the others: a failed one may still work on it."""
        return [other for other in open if other != replica]

    def failed(self, request: bytes, replica: int, now: float) -> None:
        """Move on from a replica that failed."""
        if replica == self._current:
            self._failed = True

    def awaits(self, request: bytes, replica: int) -> bool:
        """Await nothing."""
        return False

    def late(self, request: bytes, replica: int, now: float, *, answered: bool) -> None:
        """Learn nothing."""

    def stopped(
        self, request: bytes, open: Mapping[int, float], now: float, *, expired: bool = False
    ) -> None:
        """Move on from a replica that let a deadline pass: its service may hang."""
        if expired and self._current in open:
            self._failed = True

    def report(self) -> dict[str, Any]:
        """Return how often the replica changed."""
        return {"switched": self.switched}
