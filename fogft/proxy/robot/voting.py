"""A plain service whose answer is what a quorum of replicas agree on.

An answer that decides nothing ends its attempt, and the request goes on waiting for others.
The losers are not told to stop: what they would have said is what tells a wrong replica.

Owns: bringing votes and requests together. Not here: votes (`fogft.requests.votes`), all that
a service without them does (`dispatcher`).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import Any, Protocol

from fogft.errors import RosError
from fogft.link.port import Answer, Link
from fogft.model.refusal import Refusal
from fogft.proxy.robot.dispatcher import Dispatcher, key_of
from fogft.requests.first_response import Pending
from fogft.requests.votes import Ballot, Votes

log = logging.getLogger(__name__)


class Comparison(Protocol):
    """Reads responses and compares them."""

    def read(self, payload: bytes) -> Any:
        """Return what a response says. Raises RosError for bytes that are none."""

    def agree(self, one: Any, other: Any) -> bool:
        """Whether two responses say the same."""


class VotingDispatcher(Dispatcher):
    """`Dispatcher` for ``quorum: k``.

    Args:
        comparison: What agreeing means.
        others: As for `Dispatcher`.
    """

    def __init__(self, *args: Any, comparison: Comparison, **others: Any) -> None:
        super().__init__(*args, **others)
        self._comparison = comparison
        self._votes: Votes[Any] = Votes(self.spec.quorum, comparison.agree)

    def answered(self, link: Link, answer: Answer) -> None:
        """Take the end of an attempt from a link's thread: a vote, where it is an answer."""
        payload, replica, request = answer.payload, key_of(link), answer.request_id
        if payload is None:
            super().answered(link, answer)
            return
        try:
            value = self._comparison.read(payload)
        except RosError:
            super().answered(link, answer._replace(payload=None, refusal=Refusal.MALFORMED))
            return
        with self._lock:
            if request not in self._requests and not self._votes.is_final(request):
                final = None  # it has expired
            else:
                flagged = replica in self._votes.flagged
                final = self._votes.vote(request, Ballot(replica, value, payload))
                if not flagged and replica in self._votes.flagged:
                    log.error(
                        "replica_disagrees service=%s replica=%s count=%d",
                        self.spec.name, link.peer.id.short, self._votes.disagreed[replica],
                    )  # fmt: skip
        if final is not None:
            super().answered(link, answer._replace(payload=final))
            return
        with self._lock:
            if request in self._requests:
                now = self._clock()
                self._requests.failed(request, replica, now, counts=False, bar=True)
                return
        self._outcomes.late()

    def _forget(self, request: bytes, replicas: Iterable[int]) -> None:
        if not self._votes.is_final(request):
            super()._forget(request, replicas)

    def _expired(self, request: bytes, pending: Pending[Any]) -> None:
        with self._lock:
            self._votes.close(request)
        super()._expired(request, pending)

    def disagrees(self, replica: int) -> bool:
        """Whether a replica has disagreed repeatedly, and counts no more."""
        return replica in self._votes.flagged

    def report(self) -> dict[str, Any]:
        """Return counters, latency quantiles (seconds), and how often replicas disagreed."""
        disagreed = {
            f"{key >> 32}.{key & 0xFFFFFFFF}": count for key, count in self._votes.disagreed.items()
        }
        return {**super().report(), "disagreed": disagreed}
