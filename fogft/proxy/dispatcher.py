"""One proxied service on the robot: send a request to all replicas, return the first success.

`submit` is called by the thread that takes ROS requests and never blocks: a link takes an
attempt or says no. Answers come from the links' threads. A request that a link did not take,
or failed, is offered to it again until its deadline.

Owns: one service's requests, its counters, and the order of offers.
Not here: which answer wins (`fogft.core.first_response`), links (`fogft.wire`), ROS.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from fogft.core.errors import RosError
from fogft.core.first_response import FirstResponse, Pending, Verdict
from fogft.core.model import ReplicaId
from fogft.core.names import REQUEST_ID_BYTES
from fogft.core.spec import OnTimeout, ServiceSpec
from fogft.wire.port import Answer, Link, Refusal

log = logging.getLogger(__name__)

Respond = Callable[[Any, bytes], None]

# A refusal after which the same replica is not asked again for the same request: asking
# again would run it twice (FORGOTTEN) or cannot end otherwise.
_FINAL_REFUSALS = frozenset({Refusal.FORGOTTEN, Refusal.MALFORMED, Refusal.EXPIRED})
# The replica never began, or may never have seen it: no sign against the request itself.
_BLAMELESS_REFUSALS = frozenset({Refusal.LOST, Refusal.NOT_READY, Refusal.OVERLOADED})
_LATENCIES_KEPT = 2000


class _Request:
    """What is kept with a request: its bytes, the handle of its caller, when it came."""

    __slots__ = ("arrived", "handle", "payload")

    def __init__(self, payload: bytes, handle: Any, arrived: float) -> None:
        self.payload = payload
        self.handle = handle
        self.arrived = arrived


class Dispatcher:
    """The requests of one service, from the caller's request to the caller's response.

    Args:
        spec: The service and its policy.
        respond: Sends a response to the caller of a handle. Any thread.
        is_ok: Whether a response is a success; None when every response is.
        empty_response: The serialised default response, for ``on_timeout: empty``.
        clock: Monotonic seconds.
        max_pending_bytes: Requests kept at once, in bytes; more are turned away and counted.
    """

    def __init__(
        self,
        spec: ServiceSpec,
        respond: Respond,
        *,
        is_ok: Callable[[bytes], bool] | None = None,
        empty_response: bytes | None = None,
        clock: Callable[[], float] = time.monotonic,
        max_pending_bytes: int = 256 << 20,
    ) -> None:
        self.spec = spec
        self._respond = respond
        self._is_ok = is_ok
        self._empty_response = empty_response
        self._clock = clock
        self._max_pending_bytes = max_pending_bytes
        self._pending_bytes = 0
        self._lock = threading.Lock()
        self._requests: FirstResponse[_Request] = FirstResponse()
        self._links: tuple[Link, ...] = ()
        self._latencies: deque[float] = deque(maxlen=_LATENCIES_KEPT)
        self._won: dict[ReplicaId, int] = {}
        self._count = dict.fromkeys(
            (
                *("received", "answered", "late", "rejected", "silent", "empty"),
                *("turned_away", "undelivered"),
            ),
            0,
        )
        self._refusals: dict[str, int] = {}

    # -- requests -------------------------------------------------------------------------

    def submit(self, payload: bytes, handle: Any) -> None:
        """Take a caller's request and offer it to every link that can answer it."""
        now = self._clock()
        request = os.urandom(REQUEST_ID_BYTES)
        links = self._links
        with self._lock:
            self._count["received"] += 1
            if self._pending_bytes + len(payload) > self._max_pending_bytes:
                self._count["turned_away"] += 1
                turned_away = self._count["turned_away"]
                links = ()
            else:
                turned_away = 0
                self._pending_bytes += len(payload)
                self._requests.register(
                    request,
                    deadline=now + self.spec.timeout_s,
                    item=_Request(payload, handle, now),
                    replicas=[_key(link) for link in links],
                )
        if turned_away:
            if turned_away & (turned_away - 1) == 0:  # log the 1st, 2nd, 4th, 8th, ...
                log.warning(
                    "request_turned_away service=%s pending_bytes=%d count=%d",
                    self.spec.name, self._pending_bytes, turned_away,
                )  # fmt: skip
            return
        for link in links:
            if not link.offer(self.spec.name, request, payload, self.spec.timeout_s):
                with self._lock:
                    self._requests.declined(request, _key(link))
        if len(links) > 1 and request not in self._requests:
            # Answered before the last link had it: `answered` could not reach that one.
            for link in links:
                link.forget(request)

    def answered(self, link: Link, answer: Answer) -> None:
        """Take the end of an attempt from a link's thread."""
        payload = answer.payload
        if payload is None:
            self._refused(_key(link), answer)
            return
        now = self._clock()
        if self._is_ok is not None:
            try:
                ok = self._is_ok(payload)
            except RosError:  # no response of this type
                self._refused(_key(link), replace(answer, refusal=Refusal.MALFORMED))
                return
            if not ok:
                self._rejected(_key(link), answer.request_id, payload)
                return
        with self._lock:
            _, pending = self._requests.succeeded(answer.request_id, now)
            if pending is None:
                self._count["late"] += 1
                return
            self._close(pending)
            self._count["answered"] += 1
            replica = link.peer.id
            self._won[replica] = self._won.get(replica, 0) + 1
            self._latencies.append(now - pending.item.arrived)
        self._return(pending.item.handle, payload)
        if len(pending.open) > 1:
            for other in self._links:
                if other is not link:
                    other.forget(answer.request_id)

    def _refused(self, replica: int, answer: Answer) -> None:
        with self._lock:
            self._refusals[answer.refusal] = self._refusals.get(answer.refusal, 0) + 1
            verdict = self._requests.failed(
                answer.request_id,
                replica,
                self._clock(),
                counts=answer.refusal not in _BLAMELESS_REFUSALS,
                bar=answer.refusal in _FINAL_REFUSALS,
            )
        if verdict is Verdict.IDLE:
            self._settle(answer.request_id)

    def _rejected(self, replica: int, request: bytes, payload: bytes) -> None:
        with self._lock:
            self._count["rejected"] += 1
            verdict = self._requests.rejected(request, replica, payload)
        if verdict is Verdict.IDLE:
            self._settle(request)

    def _settle(self, request: bytes) -> None:
        """Nobody works on a request: return its rejection if no other replica can be asked."""
        with self._lock:
            pending = self._requests.get(request)
            if pending is None or pending.open or pending.rejection is None:
                return
            if any(_key(link) not in pending.barred for link in self._links):
                return
            self._requests.close(request)
            self._close(pending)
            self._count["answered"] += 1
        self._return(pending.item.handle, pending.rejection)

    def _return(self, handle: Any, payload: bytes) -> None:
        """Send a response to its caller. One that ROS does not take harms no other request."""
        try:
            self._respond(handle, payload)
        except RosError as error:
            with self._lock:
                self._count["undelivered"] += 1
                count = self._count["undelivered"]
            if count & (count - 1) == 0:  # log the 1st, 2nd, 4th, 8th, ...
                log.warning(
                    "response_undelivered service=%s reason=%r count=%d",
                    self.spec.name, error.message, count,
                )  # fmt: skip

    def _close(self, pending: Pending[_Request]) -> None:
        self._pending_bytes -= len(pending.item.payload)

    # -- links and time -------------------------------------------------------------------

    def route(self, links: Sequence[Link]) -> None:
        """Set the links that can answer this service now, and offer them what they lack."""
        added = [link for link in links if link not in self._links]
        self._links = tuple(links)
        for link in added:
            with self._lock:
                lacking = self._requests.lacking(_key(link))
            self._offer_again(link, lacking)

    def tick(self) -> None:
        """Let requests expire, and offer again what links did not take or failed. Call at 50 Hz."""
        now = self._clock()
        with self._lock:
            expired = self._requests.expire(now)
            for _, pending in expired:
                self._close(pending)
            owed = [(link, self._requests.owed(_key(link), now)) for link in self._links]
        for request, pending in expired:
            self._expired(request, pending)
        for link, requests in owed:
            self._offer_again(link, requests)
        with self._lock:
            idle = [request for request, _ in self._requests.idle()]
        for request in idle:
            self._settle(request)

    def _offer_again(self, link: Link, requests: Sequence[bytes]) -> None:
        replica = _key(link)
        for request in requests:
            with self._lock:
                pending = self._requests.attempt(request, replica)
            if pending is None:
                continue
            remaining_s = pending.deadline - self._clock()
            if not link.offer(self.spec.name, request, pending.item.payload, remaining_s):
                with self._lock:
                    self._requests.declined(request, replica)
                return  # its window is full: the rest would be declined as well

    def _expired(self, request: bytes, pending: Pending[_Request]) -> None:
        response = pending.rejection
        if response is not None:
            outcome = "answered"
        elif self.spec.on_timeout is OnTimeout.EMPTY and self._empty_response is not None:
            outcome, response = "empty", self._empty_response
        else:
            outcome = "silent"
        with self._lock:
            self._count[outcome] += 1
        log.warning(
            "request_timed_out service=%s outcome=%s waited_s=%.3f open=%s request=%s",
            self.spec.name, outcome, self.spec.timeout_s, sorted(pending.open), request.hex(),
        )  # fmt: skip
        if response is not None:
            self._return(pending.item.handle, response)
        for link in self._links:
            link.forget(request)

    # -- what people see ------------------------------------------------------------------

    def won(self, replica: ReplicaId) -> int:
        """Return how many requests a replica has answered first."""
        return self._won.get(replica, 0)

    def report(self) -> dict[str, Any]:
        """Return counters and latency quantiles (seconds; None before the first answer)."""
        with self._lock:
            ordered = sorted(self._latencies)
            return {
                **self._count,
                "refused": dict(self._refusals),
                "pending": len(self._requests),
                "pending_bytes": self._pending_bytes,
                "p50_s": ordered[len(ordered) // 2] if ordered else None,
                "p99_s": ordered[int(len(ordered) * 0.99)] if ordered else None,
            }


def _key(link: Link) -> int:
    """Return a small number for the replica of a link: slot and generation."""
    id = link.peer.id
    return id.slot << 32 | id.generation
