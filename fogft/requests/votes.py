"""Quorum: find the answer that k replicas agree on, and flag replicas that keep disagreeing. Pure.

Not here: what counts as agreement (`fogft.ros.messages`), requests and deadlines (`pending`).
"""

from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any

from fogft.model.replica import short
from fogft.requests.decide import Decide, Judgement, Means, Pending

WINDOW = 20  # a replica's last answers that count
LIMIT = 3  # a replica with this many disagreements among them is flagged


class Quorum(Decide):
    """``quorum: k``: return an answer that k replicas agree on; see `decide.Decide`.

    Replicas keep working on a decided request: later answers show which replicas are wrong.
    `newly_flagged` is called with a replica that is now flagged and its count of disagreements.
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
        self.quorum = quorum
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
        """Take a vote: SUCCESS if it completes a quorum. Flagged replicas do not count."""
        if replica in self.flagged:  # its answer was not read
            return Means.UNDECIDED
        if id in self._final:
            self._judge(replica, agrees=self._agree(reading, self._final[id]))
            return Means.UNDECIDED
        if pending is None:
            return Means.UNDECIDED  # the request has expired
        ballots = self._open.setdefault(id, {})
        if replica in ballots:
            return Means.UNDECIDED  # a duplicate: each replica has one vote
        ballots[replica] = reading
        # Compare only once: comparing large answers blocks the receiving thread.
        agreeing = {r for r, it in ballots.items() if it is reading or self._agree(it, reading)}
        if len(agreeing - self.flagged) < self.quorum:
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
        """Whether the request was decided recently: later answers are compared with the result."""
        return request in self._final

    def report(self) -> dict[str, Any]:
        """Return the quorum, and how often each replica disagreed, by ``slot.generation``."""
        disagreed = {short(key): n for key, n in self.disagreed.items()}
        return {"quorum": self.quorum, "disagreed": disagreed}
