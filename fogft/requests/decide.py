"""Decide what an answer means for its request: by default, the first success wins. Pure.

Not here: votes (`requests.votes`), actions and stateful services (`proxy.robot`), which requests
await an answer (`pending`).
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

from fogft.model.refusal import Refusal

Accepts = Callable[[bytes], bool]


class Trace(NamedTuple):
    """The replicas asked for a traced request. Moments are monotonic seconds."""

    asked: dict[int, float]  # each replica that took the request, and when it was first asked
    refused: dict[int, Refusal]  # each replica that refused the request, and its last reason


@dataclass(slots=True)
class Pending:
    """A request that awaits its answer. Moments are monotonic seconds.

    `deaths` counts how often a service died while working on this request. Deaths while other
    replicas had it too, or other requests ran beside it, count as one altogether.
    """

    deadline: float
    payload: bytes
    handle: Any  # the caller's, opaque here
    arrived: float
    open: dict[int, float] = field(default_factory=dict)  # replicas working on it, and since when
    barred: set[int] = field(default_factory=set)  # replicas that must not be asked again
    failures: dict[int, int] = field(default_factory=dict)  # failures that count, by replica
    # Backoff of each replica that failed the request: when it ends, and its length in seconds.
    waits: dict[int, tuple[float, float]] = field(default_factory=dict)
    rejection: bytes | None = None  # the last valid response that was not ok
    deaths: int = 0
    alone_at: set[int] = field(default_factory=set)  # replicas that got it after a death: run alone
    alone_until: float = 0.0  # when half of the time left is over: then another one is asked
    died_at: set[int] = field(default_factory=set)  # replicas whose service died while running it
    trace: Trace | None = None


class Means(Enum):
    """The effect of an answer on its request."""

    SUCCESS = "success"  # return the answer, unless another one was first
    REJECTION = "rejection"  # not ok: returned only when nothing better can come
    WEAKER_REJECTION = "weaker-rejection"  # the rejection already kept is more informative
    UNDECIDED = "undecided"  # depends on other replicas' answers
    LATE = "late"  # a good answer, but not to be returned
    NOTHING = "nothing"  # about no request


Judgement = Means | Refusal  # a refusal: as if the replica had refused the request


class Send(NamedTuple):
    """Something to send to a replica, such as a copy of a caller's request."""

    replica: int
    id: bytes
    payload: bytes
    timeout_s: float
    is_copy: bool = False  # a copy of a caller's request, and counted as one


class Reachable(NamedTuple):
    """The reachable replicas: those newly reachable, all of them, and those draining."""

    come: Collection[int]
    versions: Mapping[int, str]  # all, with the version that each runs
    draining: Collection[int]


class Decide:
    """Judges answers: the first response counts; with `accepts`, the first ok one.

    All methods but `read`, which may be slow, are called under the dispatcher's lock. Subclasses
    override the rest.
    """

    flagged: Collection[int] = ()  # replicas whose answers do not count, nor are read, any more
    quorum = 1  # replicas that must agree on an answer
    # `replicates`: replicas get more than single requests, so `request_of`, `reach`, `take` and
    # `declined` are called. `sends_requests`: requests are sent by `take` too, not by the policy.
    replicates = False
    sends_requests = False

    def __init__(self, accepts: Accepts | None = None) -> None:
        self.accept(accepts)

    def accept(self, accepts: Accepts | None) -> None:
        """Set which responses are ok; None for all."""
        self.accepts = accepts
        # If so, any response is a success: the methods about one request need no call.
        self.takes_any = accepts is None and type(self) is Decide

    def answer_to(self, request: bytes, payload: bytes) -> bytes | None:
        """Return the answer to a new request that no replica may get; None for any other."""
        return None

    def began(self, request: bytes, pending: Pending, able: Collection[int]) -> None:
        """Note a new request, and the replicas that can answer it."""

    def read(self, payload: bytes) -> Any:
        """Parse an answer; here, whether it is ok. Raises RosError if it is not of this type."""
        return self.accepts is None or self.accepts(payload)

    def judge(
        self, id: bytes, replica: int, payload: bytes, reading: Any, pending: Pending | None
    ) -> Judgement:
        """Return what an answer means."""
        return Means.SUCCESS if reading else Means.REJECTION

    def refused(
        self, id: bytes, replica: int, refusal: Refusal, detail: str, pending: Pending | None
    ) -> None:
        """Note that an attempt was refused or lost."""

    def closed(self, request: bytes, pending: Pending) -> None:
        """Note that a request has ended in any way."""

    def hears_out(self, request: bytes) -> bool:
        """Whether replicas must go on working on a request that has ended."""
        return self.replicates

    def report(self) -> dict[str, Any]:
        """Return counters and state, for people."""
        return {}

    def hold(self) -> None:
        """Stop ordering requests: another proxy takes over."""

    def take_over(self, now: float) -> None:
        """Start ordering requests, after another proxy has stopped."""

    @property
    def held(self) -> Collection[bytes]:
        """Return the requests held until `take_over`."""
        return ()

    @property
    def ready(self) -> bool:
        """Whether a request taken now can be answered, if `sends_requests`."""
        return True

    def request_of(self, id: bytes) -> bytes | None:
        """Return the request that an attempt belongs to; None for none. Needs no lock."""
        return id

    def reach(self, replicas: Reachable, now: float) -> None:
        """Set the reachable replicas."""

    def take(self, now: float, timeout_s: float) -> Sequence[Send]:
        """Return what to send now, in order; requests have a timeout of `timeout_s`."""
        return ()

    def declined(self, id: bytes, replica: int, now: float) -> None:
        """Note that a link did not accept an attempt."""

    def close(self) -> None:
        """Close: the service is no longer proxied."""
