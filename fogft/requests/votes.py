"""The answer that k replicas agree on, and who keeps disagreeing. Pure.

Every answer to a request is a ballot. An answer with which `quorum` ballots agree, its own
included, is final; every ballot is then judged by it, also those that come later. A minority
is never returned, and without a final answer nobody is blamed: two that differ do not tell
who is wrong.

Owns: ballots, final answers (for a while), each replica's record.
Not here: what agreeing means (`fogft.ros.comparison`), requests and deadlines.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T")

WINDOW = 20  # judged answers of a replica that count
LIMIT = 3  # disagreements among them that make it flagged


@dataclass(frozen=True)
class Ballot(Generic[T]):
    """One replica's answer to one request."""

    replica: int
    value: T
    payload: bytes


class Votes(Generic[T]):
    """The ballots of one service.

    Args:
        quorum: How many replicas must agree.
        agree: Whether two answers are the same, within what is tolerated. Symmetric.
        kept: Final answers kept to judge late ballots by.
    """

    def __init__(self, quorum: int, agree: Callable[[T, T], bool], *, kept: int = 256) -> None:
        self.quorum = quorum
        self.flagged: set[int] = set()
        self.disagreed: dict[int, int] = {}
        self._agree = agree
        self._kept = kept
        self._open: dict[bytes, list[Ballot[T]]] = {}
        self._final: OrderedDict[bytes, T] = OrderedDict()
        self._record: dict[int, deque[bool]] = {}

    def is_final(self, request: bytes) -> bool:
        """Whether a request has its answer (and it is not long ago)."""
        return request in self._final

    @property
    def undecided(self) -> int:
        """How many requests are being voted on."""
        return len(self._open)

    def vote(self, request: bytes, ballot: Ballot[T]) -> bytes | None:
        """Take an answer. Return the final one, once: when this ballot decided it.

        A flagged replica's ballot does not count; it is judged all the same.
        """
        if request in self._final:
            self._judge(ballot, self._final[request])
            return None
        ballots = self._open.setdefault(request, [])
        if any(other.replica == ballot.replica for other in ballots):
            return None  # a copy: one replica has one vote
        ballots.append(ballot)
        if ballot.replica in self.flagged:
            return None
        counted = [b for b in ballots if b.replica not in self.flagged]
        if sum(self._agree(b.value, ballot.value) for b in counted) < self.quorum:
            return None
        del self._open[request]
        self._final[request] = ballot.value
        if len(self._final) > self._kept:
            self._final.popitem(last=False)
        for other in ballots:
            self._judge(other, ballot.value)
        return ballot.payload

    def close(self, request: bytes) -> None:
        """A request has ended without a final answer."""
        self._open.pop(request, None)

    def _judge(self, ballot: Ballot[T], final: T) -> None:
        agrees = self._agree(ballot.value, final)
        record = self._record.setdefault(ballot.replica, deque(maxlen=WINDOW))
        record.append(agrees)
        if not agrees:
            self.disagreed[ballot.replica] = self.disagreed.get(ballot.replica, 0) + 1
            if record.count(False) >= LIMIT:
                self.flagged.add(ballot.replica)
