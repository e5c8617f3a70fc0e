"""Quorum: the answer that k replicas agree on, and replicas that keep disagreeing. Pure.

Not here: what agreeing means (`fogft.ros.messages`), requests and deadlines (`pending`).
"""

from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any

from fogft.model.replica import short
from fogft.requests.decide import Decide, Judgement, Means, Pending

WINDOW = 20  # judged answers of a replica that count
LIMIT = 3  # disagreements among them that make it flagged


class Quorum(Decide):
    """``quorum: k``: an answer with which k replicas agree; see `decide.Decide`.

    Replicas go on working on a request that has its answer: what they say tells a wrong one.
    `newly_flagged` is told who has disagreed once too often, and how often.
    """

    kept, kept_bytes = 256, 16 << 20  # final answers, to judge late ballots by

    def __init__(
        self,
        quorum: int,
        read: Callable[[bytes], Any],
        agree: Callable[[Any, Any], bool],
        newly_flagged: Callable[[int, int], None] = lambda replica, count: None,
    ) -> None:
        super().__init__()
        self.flagged: set[int] = set()
        self.disagreed: dict[int, int] = {}
        self._quorum = quorum
        self._agree = agree
        self._read = read
        self._newly_flagged = newly_flagged
        self._open: dict[bytes, dict[int, Any]] = {}  # each replica's answer
        self._final: OrderedDict[bytes, Any] = OrderedDict()
        self._record: dict[int, deque[bool]] = {}

    def read(self, payload: bytes) -> Any:
        """Read a response. Raises RosError for invalid bytes."""
        return self._read(payload)

    def judge(
        self, id: bytes, replica: int, payload: bytes, reading: Any, pending: Pending | None
    ) -> Judgement:
        """Take a vote; it is a success if it completes a quorum. Flagged replicas do not count."""
        if id in self._final:
            self._judge(replica, agrees=self._agree(reading, self._final[id]))
            return Means.UNDECIDED
        if pending is None:
            return Means.UNDECIDED  # it has expired
        ballots = self._open.setdefault(id, {})
        if replica in ballots:
            return Means.UNDECIDED  # a copy: one replica has one vote
        ballots[replica] = reading
        if replica in self.flagged:
            return Means.UNDECIDED
        # Once: of a large answer each comparison holds the receiving thread up.
        agreeing = {r for r, it in ballots.items() if it is reading or self._agree(it, reading)}
        if len(agreeing - self.flagged) < self._quorum:
            return Means.UNDECIDED
        del self._open[id]
        self._final[id] = reading
        kept = min(self.kept, max(1, self.kept_bytes // (len(payload) or 1)))
        while len(self._final) > kept:
            self._final.popitem(last=False)
        for voter in ballots:
            self._judge(voter, agrees=voter in agreeing)
        return Means.SUCCESS

    def _judge(self, replica: int, *, agrees: bool) -> None:
        record = self._record.setdefault(replica, deque(maxlen=WINDOW))
        record.append(agrees)
        if not agrees:
            self.disagreed[replica] = self.disagreed.get(replica, 0) + 1
            if record.count(False) >= LIMIT and replica not in self.flagged:
                self.flagged.add(replica)
                self._newly_flagged(replica, self.disagreed[replica])

    def closed(self, request: bytes, pending: Pending) -> None:
        """Forget the votes on a request without a quorum."""
        self._open.pop(request, None)

    def hears_out(self, request: bytes) -> bool:
        """Whether it was decided recently, so that later answers are compared with it."""
        return request in self._final

    def report(self) -> dict[str, Any]:
        """Return how often replicas disagreed, by ``slot.generation``."""
        return {"disagreed": {short(key): n for key, n in self.disagreed.items()}}
