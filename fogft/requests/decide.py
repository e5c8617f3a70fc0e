"""Decide what an answer means for its request: first success, or what a quorum agrees on. Pure.

An answer goes through `read` first, which may be slow: no lock is held. Then `judge` says what it
means.

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

    asked: dict[int, float]  # each replica that took it, and when it was asked first
    refused: dict[int, Refusal]  # each replica that refused it, and its last reason


@dataclass(slots=True)
class Pending:
    """A request that awaits its answer. Moments are monotonic seconds.

    `deaths` counts how often a service died while it worked on this: those that died together over
    copies of it, and of other requests, count as one.
    """

    deadline: float
    payload: bytes
    handle: Any  # of its caller
    arrived: float
    open: dict[int, float] = field(default_factory=dict)  # who works on it, and since when
    barred: set[int] = field(default_factory=set)  # replicas that must not be asked again
    failures: dict[int, int] = field(default_factory=dict)  # those that count, by replica
    # Until when a replica that failed it is left alone, and that wait.
    waits: dict[int, tuple[float, float]] = field(default_factory=dict)
    rejection: bytes | None = None  # the last response that was real but not ok
    deaths: int = 0
    alone_at: set[int] = field(default_factory=set)  # who got it with nothing beside it since
    alone_until: float = 0.0  # then another one is asked: half of the time left is over
    died_at: set[int] = field(default_factory=set)  # replicas where services died over it
    trace: Trace | None = None


class Means(Enum):
    """The effect of an answer on its request."""

    SUCCESS = "success"  # return it, unless another one was first
    REJECTION = "rejection"  # the service says no: returned only when nothing better can come
    WEAKER_REJECTION = "weaker-rejection"  # the one that is kept already says more
    UNDECIDED = "undecided"  # it depends on what others say
    LATE = "late"  # a good one, but not to be returned
    NOTHING = "nothing"  # it is about no request


Judgement = Means | Refusal  # a refusal: as if the replica had refused the request


class Send(NamedTuple):
    """Something to send to a replica, such as a copy of a caller's request."""

    replica: int
    id: bytes
    payload: bytes
    timeout_s: float
    is_copy: bool = False  # of a caller's request, and counted as one


class Reachable(NamedTuple):
    """The reachable replicas: new ones, all, and those that are draining."""

    come: Collection[int]
    versions: Mapping[int, str]  # what each runs
    draining: Collection[int]


class Decide:
    """Judges answers: the first response counts; with `accepts`, the first ok one.

    All but `read` is called under the dispatcher's lock. What differs is overridden.
    """

    flagged: Collection[int] = ()  # replicas whose answers do not count any more
    # Replicas must have more than single requests: `request_of`, `reach`, `take` and `declined` are
    # asked. With the second, requests leave by `take`, too, and are not chosen for.
    replicates = False
    sends_requests = False

    def __init__(self, accepts: Accepts | None = None) -> None:
        self.accept(accepts)

    def accept(self, accepts: Accepts | None) -> None:
        """Set which responses are ok; None for all."""
        self.accepts = accepts
        # Then any response is a success: `began`, `read`, `judge` and `closed` need not be asked.
        self.takes_any = accepts is None and type(self) is Decide

    def began(self, request: bytes, pending: Pending, able: Collection[int]) -> None:
        """Note a new request, and the replicas that can answer it."""

    def read(self, payload: bytes) -> Any:
        """Read an answer; here, whether it is ok. Raises RosError: it is not of this type."""
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
        """Whether replicas keep working on a request that has ended: they must have it."""
        return self.replicates

    def report(self) -> dict[str, Any]:
        """Return counters and state, for people."""
        return {}

    def hold(self) -> None:
        """Stop ordering: another proxy does."""

    def take_over(self, now: float) -> None:
        """Start ordering, after another proxy has stopped."""

    @property
    def held(self) -> Collection[bytes]:
        """Return the requests held until then."""
        return ()

    @property
    def ready(self) -> bool:
        """Whether a request taken now can be answered, if `sends_requests`."""
        return True

    def request_of(self, id: bytes) -> bytes | None:
        """Return the request of an attempt; None for none. Needs no lock."""
        return id

    def reach(self, replicas: Reachable, now: float) -> None:
        """Set the reachable replicas."""

    def take(self, now: float, timeout_s: float) -> Sequence[Send]:
        """Return what to send now, in order; requests have `timeout_s`."""
        return ()

    def declined(self, id: bytes, replica: int, now: float) -> None:
        """Note that a link did not accept an attempt."""

    def close(self) -> None:
        """Close: the service is no longer proxied."""
