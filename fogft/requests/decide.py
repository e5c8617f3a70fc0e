"""Decide what an answer means for its request: first success, or what a quorum agrees on. Pure.

An answer goes through `read` first, which looks into its bytes and may be slow: no lock is held.
Bytes that are no response are refused there, before they count. Then `judge` says what it means.

Owns: the interface of every decision; the first success, and the first that is ok.
Not here: votes (`fogft.requests.votes`), actions (`fogft.proxy.robot.actions`), stateful services
(`fogft.proxy.robot.service_order`); which requests await an answer (`first_response`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from enum import Enum
from typing import Any, Protocol

from fogft.model.refusal import Refusal
from fogft.requests.first_response import Pending

Accepts = Callable[[bytes], bool]


class Means(Enum):
    """What an answer means for its request."""

    SUCCESS = "success"  # return it, unless another one was first
    REJECTION = "rejection"  # the service says no: returned only when nothing better can come
    WEAKER_REJECTION = "weaker-rejection"  # the one that is kept already says more
    UNDECIDED = "undecided"  # it depends on what others say
    LATE = "late"  # a good one, but not to be returned
    NOTHING = "nothing"  # it is about no request


Judgement = Means | Refusal  # a refusal: as if the replica had refused the request


class Decide(Protocol):
    """Says what answers mean. All but `read` is called under the dispatcher's lock.

    Attributes:
        accepts: Whether a response is a success; None where every one is.
        flagged: Replicas whose answers do not count any more.
    """

    accepts: Accepts | None

    @property
    def flagged(self) -> Collection[int]:
        """Replicas whose answers do not count any more."""

    def began(self, request: bytes, pending: Pending[Any], able: Collection[int]) -> None:
        """Note a new request, and which replicas are able to answer it."""

    def read(self, payload: bytes) -> Any:
        """Look into an answer.

        Raises:
            RosError: It is no response of this type.
        """

    def judge(
        self, id: bytes, replica: int, payload: bytes, reading: Any, pending: Pending[Any] | None
    ) -> Judgement:
        """Return what an answer means.

        Args:
            id: Of the attempt.
            replica: Who answered.
            payload: The answer.
            reading: What `read` returned.
            pending: The request, while it awaits its answer.
        """

    def refused(
        self, id: bytes, replica: int, refusal: Refusal, detail: str, pending: Pending[Any] | None
    ) -> None:
        """An attempt was refused, or lost."""

    def closed(self, request: bytes, pending: Pending[Any]) -> None:
        """A request has ended, in whatever way."""

    def hears_out(self, request: bytes) -> bool:
        """Whether replicas go on working on a request that has ended."""

    def report(self) -> dict[str, Any]:
        """Return what people should know."""


class FirstSuccess:
    """The first response is the answer; with `accepts`, the first that is ok."""

    flagged: Collection[int] = ()

    def __init__(self, accepts: Accepts | None = None) -> None:
        self.accepts = accepts

    def began(self, request: bytes, pending: Pending[Any], able: Collection[int]) -> None:
        """Nothing need be noted."""

    def read(self, payload: bytes) -> bool:
        """Return whether it is ok."""
        return self.accepts is None or self.accepts(payload)

    def judge(
        self, id: bytes, replica: int, payload: bytes, reading: Any, pending: Pending[Any] | None
    ) -> Judgement:
        """Return whether it is a success."""
        return Means.SUCCESS if reading else Means.REJECTION

    def refused(
        self, id: bytes, replica: int, refusal: Refusal, detail: str, pending: Pending[Any] | None
    ) -> None:
        """Nothing need be noted."""

    def closed(self, request: bytes, pending: Pending[Any]) -> None:
        """Nothing need be noted."""

    def hears_out(self, request: bytes) -> bool:
        """Nobody goes on: the others' answers are of no use."""
        return False

    def report(self) -> dict[str, Any]:
        """Return nothing."""
        return {}
