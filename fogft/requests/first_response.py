"""First success wins: decide what each answer means. Pure: time comes in, a verdict goes out.

One `FirstResponse` holds the requests of one service that still await an answer. Every
request has the replicas that work on it (its open attempts). The first success takes the
request out of the table, so that whatever comes later is LATE by construction: a late
answer can never reach another request, and no request is answered twice.

An attempt ends as a success, a failure (refusal, crash, lost link) or a rejection: a real
response that the service itself marks as not ok. A rejection is kept, and is returned
only when nothing better can come.

A replica that declined a request, failed it or came after it may be asked (again) even while
others work on it, because those others may be frozen. Whether it is, is the policy's to say.

Owns: which answer is returned, who may be asked, and when a request has nobody working on it.
Not here: what an answer means (`decide`), who is asked (`choose`), sending, locks and clocks
(`fogft.proxy.robot.dispatcher`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Generic, TypeVar

T = TypeVar("T")

RETRY_FIRST_S = 0.02
RETRY_LIMIT_S = 0.32
_NO_WAIT = (0.0, 0.0)


class Verdict(Enum):
    """What to do after an attempt has ended."""

    WON = "won"  # return this answer; the request is closed
    WAIT = "wait"  # another attempt is still open
    IDLE = "idle"  # nobody works on it any more: try again, or return the rejection
    LATE = "late"  # already answered, expired or never known: drop it
    POISON = "poison"  # services died over it: it is not to be sent again


@dataclass
class Pending(Generic[T]):
    """A request that awaits its answer.

    Attributes:
        failures: How often an attempt at each replica has failed, those that count.
        waits: Until when a replica that failed it is left alone, and that wait, in seconds.
        deaths: How often a service died while it worked on this: those that died together over
            copies of it, and of other requests, count as one.
        alone_at: The replica that works on it with nothing beside it, since a service has died.
    """

    deadline: float
    item: T
    open: dict[int, float] = field(default_factory=dict)
    barred: set[int] = field(default_factory=set)
    failures: dict[int, int] = field(default_factory=dict)
    waits: dict[int, tuple[float, float]] = field(default_factory=dict)
    rejection: bytes | None = None
    deaths: int = 0
    alone_at: int | None = None
    died_at: set[int] = field(default_factory=set)


class FirstResponse(Generic[T]):
    """The requests of one service that await an answer, oldest first."""

    def __init__(self, *, attempts: int = 3) -> None:
        self._attempts = attempts
        self._pending: dict[bytes, Pending[T]] = {}
        self.get = self._pending.get  # a request that still awaits its answer
        # Those that some replica may have to be asked for, as far as is known, and from when on.
        self._short: dict[bytes, float] = {}
        self.soonest_deadline = float("inf")
        self.has_rejected = False

    def __len__(self) -> int:
        return len(self._pending)

    def __contains__(self, request: bytes) -> bool:
        return request in self._pending

    def register(
        self,
        request: bytes,
        *,
        deadline: float,
        item: T,
        replicas: Iterable[int] = (),
        now: float = 0.0,
        complete: bool = True,
    ) -> Pending[T]:
        """Enter a request, with the replicas that are about to be asked.

        Args:
            complete: Whether these are all that there are: until something happens to it, the
                request need not be looked at again.

        Raises:
            ValueError: The id is in the table already.
        """
        if request in self._pending:
            raise ValueError("request id is registered already")
        pending = Pending(deadline, item, dict.fromkeys(replicas, now))
        self._pending[request] = pending
        self.soonest_deadline = min(self.soonest_deadline, deadline)
        if not complete or not pending.open:
            self._short[request] = 0.0
        return pending

    def attempt(self, request: bytes, replica: int, now: float = 0.0) -> Pending[T] | None:
        """Enter one more attempt; None where it is not wanted (closed, open or barred)."""
        pending = self._pending.get(request)
        if pending is None or replica in pending.open or replica in pending.barred:
            return None
        pending.open[replica] = now
        return pending

    def declined(self, request: bytes, replica: int) -> None:
        """Note that a replica did not take an attempt. It may be asked again."""
        pending = self._pending.get(request)
        if pending is not None and replica in pending.open:
            self._ended(request, pending, replica)

    def _ended(self, request: bytes, pending: Pending[T], replica: int) -> Verdict:
        del pending.open[replica]
        self._short[request] = 0.0
        return Verdict.WAIT if pending.open else Verdict.IDLE

    def succeeded(self, request: bytes, now: float) -> Pending[T] | None:
        """Note a success: return its request once, and never after its deadline."""
        pending = self._pending.get(request)
        if pending is None or now >= pending.deadline:
            return None
        del self._pending[request]
        self._short.pop(request, None)
        return pending

    def rejected(self, request: bytes, replica: int, response: bytes) -> Verdict:
        """Note a real response that is not ok: kept, and returned if nothing better comes."""
        pending = self._pending.get(request)
        if pending is None or replica not in pending.open:
            return Verdict.LATE
        pending.rejection = response
        self.has_rejected = True
        pending.barred.add(replica)
        return self._ended(request, pending, replica)

    def failed(
        self, request: bytes, replica: int, now: float, *, counts: bool, bar: bool = False
    ) -> Verdict:
        """Note a failed attempt. The replica is left alone for a moment, longer each time.

        Args:
            counts: Whether it counts towards the limit of attempts. A lost link does
                not: the replica may never have seen the request.
            bar: Never ask this replica for this request again.
        """
        pending = self._pending.get(request)
        if pending is None or replica not in pending.open:
            return Verdict.LATE
        failures = pending.failures.get(replica, 0) + (1 if counts else 0)
        pending.failures[replica] = failures
        _, waited_s = pending.waits.get(replica, (0.0, RETRY_FIRST_S / 2))
        wait_s = min(waited_s * 2, RETRY_LIMIT_S)
        pending.waits[replica] = (now + wait_s, wait_s)
        if bar or failures >= self._attempts:
            pending.barred.add(replica)
        return self._ended(request, pending, replica)

    def close(self, request: bytes) -> Pending[T] | None:
        """Take a request out, whatever its state."""
        self._short.pop(request, None)
        return self._pending.pop(request, None)

    def expire(self, now: float) -> list[tuple[bytes, Pending[T]]]:
        """Take out every request whose deadline has come, oldest first."""
        if now < self.soonest_deadline:
            return []
        expired = [entry for entry in self._pending.items() if entry[1].deadline <= now]
        for request, _ in expired:
            self.close(request)
        left = (pending.deadline for pending in self._pending.values())
        self.soonest_deadline = min(left, default=float("inf"))
        return expired

    def idle(self) -> list[bytes]:
        """Return the requests that nobody works on, in the order in which that began."""
        return [request for request in self._short if not self._pending[request].open]

    def short(self, now: float) -> tuple[list[tuple[bytes, Pending[T]]], float]:
        """Return the requests that may need another replica, and when the next one may."""
        due, later = [], float("inf")
        for request, at in self._short.items():
            if at <= now:
                due.append((request, self._pending[request]))
            elif at < later:
                later = at
        return due, later

    def look_at(self, request: bytes, at: float) -> None:
        """Leave a request out of `short` until then, unless something happens to it."""
        if request in self._short:
            self._short[request] = at

    @staticmethod
    def candidates(pending: Pending[T], able: Sequence[int], now: float) -> tuple[list[int], float]:
        """Return who may be asked now, and when the first of those left alone may be."""
        until = {
            replica: pending.waits.get(replica, _NO_WAIT)[0]
            for replica in able
            if replica not in pending.open and replica not in pending.barred
        }
        found = [replica for replica, at in until.items() if at <= now]
        return found, min(until.values(), default=float("inf"))

    def came(self, replica: int) -> None:
        """A replica came (back): it may be asked at once for all that it does not work on.

        Whoever works on those may be frozen, and a link that was reopened is to get again
        what was in flight on it.
        """
        for request, pending in self._pending.items():
            pending.waits.pop(replica, None)
            if replica not in pending.open and replica not in pending.barred:
                self._short[request] = 0.0

    def welcome(self, replica: int, about: Callable[[T], bool]) -> None:
        """A replica has begun anew what some requests are about: what it said before is void."""
        for request, pending in self._pending.items():
            if about(pending.item):
                pending.barred.discard(replica)
                pending.failures.pop(replica, None)
                pending.waits.pop(replica, None)
                if replica not in pending.open:
                    self._short[request] = 0.0

    def reconsider(self) -> None:
        """Put every request before the policy again: there is another one."""
        self._short = dict.fromkeys(self._pending, 0.0)
