"""Decide what an answer means for its request: first success, or what a quorum agrees on. Pure.

An answer goes through `read` first, which looks into its bytes and may be slow: no lock is held.
Bytes that are no response are refused there, before they count. Then `judge` says what it means.

Replicas of actions and of stateful services must have more than single requests: goals,
cancellations, an order. What decides for those says what else is to be sent, too.

Owns: the interface of every decision; the first success, and the first that is ok.
Not here: votes (`fogft.requests.votes`), actions (`fogft.proxy.robot.actions`), stateful services
(`fogft.proxy.robot.service_order`); which requests await an answer (`first_response`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from enum import Enum
from typing import Any, NamedTuple

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


class Send(NamedTuple):
    """Something to be sent to a replica; a copy of a caller's request counts as one."""

    replica: int
    id: bytes
    payload: bytes
    timeout_s: float
    is_copy: bool = False


class Reachable(NamedTuple):
    """The replicas that can be sent to: those that could not be before, all, those to go soon."""

    come: Collection[int]
    versions: Mapping[int, str]  # what each runs
    leaving: Collection[int]


class Decide:
    """Says what answers mean: the first response is the answer; with `accepts`, the first ok one.

    All but `read` is called under the dispatcher's lock. What differs is overridden.

    Args:
        accepts: Whether a response is a success; None where every one is.

    Attributes:
        flagged: Replicas whose answers do not count any more.
        replicates: Replicas must have more than single requests: `request_of`, `reach`, `take` and
            `declined` are asked.
        sends_requests: Requests leave by `take` too, in its order, and are not chosen for.
    """

    flagged: Collection[int] = ()
    replicates = False
    sends_requests = False

    def __init__(self, accepts: Accepts | None = None) -> None:
        self.accepts = accepts

    def began(self, request: bytes, pending: Pending[Any], able: Collection[int]) -> None:
        """Note a new request, and which replicas are able to answer it."""

    def read(self, payload: bytes) -> Any:
        """Look into an answer; here, whether it is ok. Raises RosError: it is none of this type."""
        return self.accepts is None or self.accepts(payload)

    def judge(
        self, id: bytes, replica: int, payload: bytes, reading: Any, pending: Pending[Any] | None
    ) -> Judgement:
        """Return what an answer means."""
        return Means.SUCCESS if reading else Means.REJECTION

    def refused(
        self, id: bytes, replica: int, refusal: Refusal, detail: str, pending: Pending[Any] | None
    ) -> None:
        """An attempt was refused, or lost."""

    def closed(self, request: bytes, pending: Pending[Any]) -> None:
        """A request has ended, in whatever way."""

    def hears_out(self, request: bytes) -> bool:
        """Whether replicas go on working on a request that has ended."""
        return False

    def report(self) -> dict[str, Any]:
        """Return what people should know."""
        return {}

    # -- what replicas must have ----------------------------------------------------------

    def hold(self) -> None:
        """Order no more: another proxy does."""

    def take_over(self, now: float) -> None:
        """Order from now on, where that was held: another proxy has given it up."""

    @property
    def held(self) -> Collection[bytes]:
        """Return the requests that wait for that."""
        return ()

    @property
    def ready(self) -> bool:
        """Whether a request that is taken now can be answered, where `sends_requests`."""
        return True

    def request_of(self, id: bytes) -> bytes | None:
        """Return the request that an attempt is about, None for none. Without the lock, too."""
        return id

    def reach(self, replicas: Reachable, now: float) -> None:
        """Note which replicas can be sent to."""

    def take(self, now: float, timeout_s: float) -> Sequence[Send]:
        """Return what is to be sent now, in this order; requests have `timeout_s`."""
        return ()

    def declined(self, id: bytes, replica: int, now: float) -> None:
        """A replica's link did not take an attempt."""

    def close(self) -> None:
        """The service is not proxied any more."""
