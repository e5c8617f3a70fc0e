"""The answer that k replicas agree on, and who keeps disagreeing. Pure.

Every answer to a request is a ballot. An answer with which `quorum` ballots agree, its own
included, is final; every ballot is then judged by it, also those that come later. A minority
is never returned, and without a final answer nobody is blamed: two that differ do not tell
who is wrong.

Owns: ballots, final answers (for a while), each replica's record.
Not here: what agreeing means (`fogft.ros.comparison`), requests and deadlines (`first_response`).
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from fogft.model.refusal import Refusal
from fogft.requests.decide import Accepts, Judgement, Means
from fogft.requests.first_response import Pending

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


class Comparison(Protocol):
    """Reads responses and compares them."""

    def read(self, payload: bytes) -> Any:
        """Return what a response says. Raises RosError for bytes that are none."""

    def agree(self, one: Any, other: Any) -> bool:
        """Whether two responses say the same."""


class Quorum:
    """``quorum: k``: an answer with which k replicas agree; see `decide.Decide`.

    Replicas go on working on a request that has its answer: what they would have said is what
    tells a wrong one.

    Args:
        quorum: How many must agree.
        comparison: What agreeing means.
        newly_flagged: Called with a replica that has disagreed once too often, and how often.
    """

    def __init__(
        self,
        quorum: int,
        comparison: Comparison,
        newly_flagged: Callable[[int, int], None] = lambda replica, count: None,
    ) -> None:
        self.accepts: Accepts | None = None
        self._read = comparison.read
        self._votes: Votes[Any] = Votes(quorum, comparison.agree)
        self._newly_flagged = newly_flagged

    @property
    def flagged(self) -> Collection[int]:
        """Replicas that have disagreed repeatedly."""
        return self._votes.flagged

    def began(self, request: bytes, pending: Pending[Any], able: Collection[int]) -> None:
        """Nothing need be noted."""

    def read(self, payload: bytes) -> Any:
        """Return what it says."""
        return self._read(payload)

    def judge(
        self, id: bytes, replica: int, payload: bytes, reading: Any, pending: Pending[Any] | None
    ) -> Judgement:
        """Take a vote; it is a success if it decides."""
        votes = self._votes
        if pending is None and not votes.is_final(id):
            return Means.UNDECIDED  # it has expired
        known = replica in votes.flagged
        decided = votes.vote(id, Ballot(replica, reading, payload)) is not None
        if not known and replica in votes.flagged:
            self._newly_flagged(replica, votes.disagreed[replica])
        return Means.SUCCESS if decided else Means.UNDECIDED

    def refused(
        self, id: bytes, replica: int, refusal: Refusal, detail: str, pending: Pending[Any] | None
    ) -> None:
        """Nothing need be noted: who refuses has no vote."""

    def closed(self, request: bytes, pending: Pending[Any]) -> None:
        """Forget the votes on a request that has none that decides."""
        self._votes.close(request)

    def hears_out(self, request: bytes) -> bool:
        """Whether it was decided: then the others are judged by it."""
        return self._votes.is_final(request)

    def report(self) -> dict[str, Any]:
        """Return how often replicas disagreed, by ``slot.generation``."""
        disagreed = self._votes.disagreed.items()
        return {"disagreed": {f"{key >> 32}.{key & 0xFFFFFFFF}": n for key, n in disagreed}}
