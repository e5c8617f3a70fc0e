"""One proxied service on the robot: send a request to replicas, return the first success.

Three questions, three owners: *whom to send to and when* is the policy's (`requests.hedging`),
*which answer is final* is the table's (`requests.first_response`), and *what became of it* is
counted by `outcomes`. The dispatcher does what they say.

`submit` is called by the thread that takes ROS requests and never blocks: a link takes an
attempt or says no. Answers come from the links' threads, which may not send; whatever must be
sent because of them is left to the next `tick`, which `wake` brings about.

Owns: one service's requests and its lock. Not here: links (`fogft.link`), ROS.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from fogft.errors import RosError
from fogft.link.port import Answer, Link
from fogft.log_limits import worth_logging
from fogft.metrics.outcomes import Outcomes
from fogft.model.choices import Freshness
from fogft.model.names import REQUEST_ID_BYTES
from fogft.model.refusal import Effect, Refusal
from fogft.model.replica import ReplicaId
from fogft.model.spec import HedgingMode, OnTimeout, ServiceSpec
from fogft.proxy.robot.fallback_caller import Rescuer, Shared, note_end
from fogft.proxy.robot.request import Request
from fogft.requests.adaptive import Adaptive
from fogft.requests.first_response import FirstResponse, Pending, Verdict
from fogft.requests.hedging import NEVER, All, Failover, Hedging
from fogft.ros.port import RosClient

log = logging.getLogger(__name__)

Respond = Callable[[Any, bytes], None]
_Short = tuple[bytes, Pending[Request]]

_TRACE_KEPT = 20_000  # lines until they are written, twice a second


class Dispatcher:
    """The requests of one service, from the caller's request to the caller's response.

    Args:
        spec: The service and its policy.
        respond: Sends a response to the caller of a handle. Any thread.
        ok_of: Returns, for a name of a boolean response field, whether a response is a success;
            asked where the spec names an `ok_field`.
        empty_response: The serialised default response, for ``on_timeout: empty``.
        wake: Has `tick` called soon. Any thread.
        clock: Monotonic seconds.
        max_pending_bytes: Requests kept at once, in bytes; more are turned away and counted.
        max_pending: The same, by number.
    """

    def __init__(
        self,
        spec: ServiceSpec,
        respond: Respond,
        *,
        ok_of: Callable[[str], Callable[[bytes], bool]] | None = None,
        empty_response: bytes | None = None,
        wake: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
        max_pending_bytes: int = 256 << 20,
        max_pending: int = 1 << 16,
    ) -> None:
        self.spec = spec
        self._respond = respond
        self._ok_of = ok_of
        self._is_ok = self._check(spec.ok_field)
        self._empty_response = empty_response
        self._wake = wake
        self._clock = clock
        self.max_pending_bytes = max_pending_bytes
        self.max_pending = max_pending
        self._pending_bytes = 0
        self._lock = threading.Lock()
        self._requests: FirstResponse[Request] = FirstResponse()
        self._hedging = _policy(spec)
        self._next_look = NEVER  # when the policy wants to be asked, as the last tick said
        self._in_burst = False
        self._links: dict[int, Link] = {}
        self._able: tuple[int, ...] = ()
        self._outcomes = Outcomes()
        self._rescuer: Rescuer | None = None
        self._follow(spec, None)

    # -- requests -------------------------------------------------------------------------

    @property
    def waiting(self) -> int:
        """How many requests have no answer yet."""
        return len(self._requests)

    def submit(self, payload: bytes, handle: Any) -> None:
        """Take a caller's request and offer it to whom the policy chooses."""
        self.forward(os.urandom(REQUEST_ID_BYTES), payload, handle, self.spec.timeout_s)

    def forward(self, request: bytes, payload: bytes, handle: Any, timeout_s: float) -> bool:
        """Do the same for a request that has its id, and so much time left; whether it was taken.

        Raises:
            ValueError: A request with this id is under way.
        """
        now = self._clock()
        count = self._outcomes.count
        with self._lock:
            self._outcomes.received(len(payload))
            bytes_over = self._pending_bytes + len(payload) > self.max_pending_bytes
            if bytes_over or len(self._requests) >= self.max_pending:
                count["turned_away"] += 1
                turned_away = count["turned_away"]
                self._outcomes.note(request, "turned_away", took_s=0.0)
            else:
                turned_away = 0
                links, able = self._links, self._able
                chosen = self._hedging.first(request, able, now)
                self._pending_bytes += len(payload)
                item = Request(payload, handle, now, traced=self._outcomes.trace is not None)
                if item.story is not None:
                    item.story.asked.update(dict.fromkeys(chosen, now))
                self._requests.register(
                    request,
                    deadline=now + timeout_s,
                    item=item,
                    replicas=chosen,
                    now=now,
                    complete=len(chosen) == len(able),
                )
                count["sent"] += len(chosen)
                soon = self._hedging.look_at
                if self._rescuer is not None and self.spec.fallback is not None:
                    soon = min(soon, self._rescuer.submitted(request, now, able=bool(able)))
        if turned_away:
            self._log_rarely("request_turned_away", turned_away, "pending is full")
            return False
        name = self.spec.name
        for replica in chosen:
            if not links[replica].offer(name, request, payload, timeout_s, more=self._in_burst):
                self._declined(request, replica)
        if len(chosen) > 1 and request not in self._requests:
            # Answered before the last link had it: `answered` could not reach that one.
            self._forget(request, chosen)
        if soon < self._next_look:
            self._wake()
        return True

    def burst(self, begins: bool) -> None:
        """Have what is submitted until the burst ends leave together, in few messages."""
        self._in_burst = begins
        if not begins:
            for link in tuple(self._links.values()):
                link.send()

    def cancel(self, request: bytes) -> None:
        """End a request that its caller no longer wants; unknown ids are fine."""
        with self._lock:
            pending = self._requests.close(request)
            if pending is None:
                return
            replicas = tuple(pending.open)
            self._stop(request, pending, self._clock())
            self._outcomes.count["cancelled"] += 1
        self._forget(request, replicas)

    def _declined(self, request: bytes, replica: int) -> None:
        with self._lock:
            self._outcomes.count["sent"] -= 1
            pending = self._requests.get(request)
            if pending is not None and pending.item.story is not None:
                pending.item.story.declined(replica, pending.open.get(replica))
            self._requests.declined(request, replica)
            self._hedging.declined(replica, full=True)

    def answered(self, link: Link, answer: Answer) -> None:
        """Take the end of an attempt from a link's thread."""
        payload = answer.payload
        replica = key_of(link)
        if payload is None:
            self._refused(link.peer.id, replica, answer)
            return
        now = self._clock()
        is_ok = self._is_ok
        if is_ok is not None:
            try:
                ok = is_ok(payload)
            except RosError:  # no response of this type
                malformed = answer._replace(refusal=Refusal.MALFORMED)
                self._refused(link.peer.id, replica, malformed)
                return
            if not ok:
                self._rejected(link.peer.id, replica, answer.request_id, payload)
                return
        request = answer.request_id
        with self._lock:
            _, pending = self._requests.succeeded(request, now)
            if pending is None:
                self._hedging.late(request, replica, now, answered=True)
            else:
                losers = self._hedging.answered(request, pending.open, replica, now)
                self._close(request, pending)
        if pending is None:
            self._count_late(link.peer.id)
            return
        self._return(pending.item.handle, payload)  # first: what is counted can wait
        self._forget(request, losers)
        self._count_won(link.peer.id, request, pending, payload, now)

    def _count_late(self, id: ReplicaId) -> None:
        with self._lock:
            self._outcomes.served(id)
        self._outcomes.late()

    def _count_won(
        self, id: ReplicaId, request: bytes, pending: Pending[Request], payload: bytes, now: float
    ) -> None:
        with self._lock:
            self._outcomes.served(id)
            self._outcomes.won(id, now - pending.item.arrived, len(payload))
            note_end(
                self._outcomes, request, pending,
                outcome="answered", now=now, replica=id.short,
            )  # fmt: skip

    def late(self, link: Link, request: bytes) -> None:
        """Count an answer that came after its link was told to forget the request."""
        self._outcomes.late()

    def _forget(self, request: bytes, replicas: Iterable[int]) -> None:
        for replica in replicas:
            link = self._links.get(replica)
            if link is not None and not self._hedging.awaits(request, replica):
                link.forget(request)

    def _refused(self, id: ReplicaId, replica: int, answer: Answer) -> None:
        now, refusal = self._clock(), answer.refusal or Refusal.LOST
        with self._lock:
            self._outcomes.refusal(refusal, id)
            pending = self._requests.get(answer.request_id)
            if pending is not None and pending.item.story is not None:
                pending.item.story.refused[replica] = refusal
            verdict = self._requests.failed(
                answer.request_id,
                replica,
                now,
                counts=Effect.BLAMELESS not in refusal.effect,
                bar=Effect.FINAL in refusal.effect,
            )
            if verdict is Verdict.LATE:
                self._hedging.late(answer.request_id, replica, now, answered=False)
            else:
                self._hedging.failed(answer.request_id, replica, now)
        if verdict is Verdict.IDLE:
            self._idle(answer.request_id)

    def _rejected(self, id: ReplicaId, replica: int, request: bytes, payload: bytes) -> None:
        with self._lock:
            self._outcomes.count["rejected"] += 1
            self._outcomes.failed(id)
            verdict = self._requests.rejected(request, replica, payload)
            if verdict is Verdict.LATE:
                self._hedging.late(request, replica, self._clock(), answered=True)
            else:
                self._hedging.failed(request, replica, self._clock())
        if verdict is Verdict.IDLE:
            self._idle(request)

    def _idle(self, request: bytes) -> None:
        """Nobody works on a request: end it, or have another replica asked at once."""
        if not self._settle(request) and self._hedging.moves_on:
            self._wake()

    def _settle(self, request: bytes) -> bool:
        """Return the rejection of a request if nobody works on it, and no other can be asked."""
        with self._lock:
            pending = self._requests.get(request)
            if pending is None or pending.open or pending.rejection is None:
                return False
            if any(replica not in pending.barred for replica in self._able):
                return False
            self._requests.close(request)
            self._close(request, pending)
            self._outcomes.count["answered"] += 1
            now = self._clock()
            note_end(self._outcomes, request, pending, outcome="answered", now=now)
        self._return(pending.item.handle, pending.rejection)
        return True

    def _return(self, handle: Any, payload: bytes) -> None:
        """Send a response to its caller. One that ROS does not take harms no other request."""
        try:
            self._respond(handle, payload)
        except RosError as error:
            with self._lock:
                self._outcomes.count["undelivered"] += 1
                count = self._outcomes.count["undelivered"]
            self._log_rarely("response_undelivered", count, error.message)

    def _log_rarely(self, event: str, count: int, reason: str) -> None:
        if worth_logging(count):
            log.warning("%s service=%s reason=%r count=%d", event, self.spec.name, reason, count)

    def _close(self, request: bytes, pending: Pending[Request]) -> None:
        self._pending_bytes -= len(pending.item.payload)
        if self._rescuer is not None:
            self._rescuer.ended(request)

    def _stop(self, request: bytes, pending: Pending[Request], now: float) -> None:
        """Somebody else than a replica has answered."""
        self._hedging.stopped(request, pending.open, now)
        self._close(request, pending)

    # -- policy, links and time -----------------------------------------------------------

    def adopt(self, spec: ServiceSpec, fallback: RosClient | None = None) -> None:
        """Follow another policy from now on; requests under way keep their deadlines.

        Args:
            spec: The policy.
            fallback: The client of its fallback service, if it has one.

        Raises:
            RosError: The response has no such `ok_field`; nothing was changed.
        """
        is_ok = self._is_ok if spec.ok_field == self.spec.ok_field else self._check(spec.ok_field)
        with self._lock:
            self._is_ok = is_ok
            old, self.spec = self.spec, spec
            self._follow(spec, fallback)
            if (old.hedging, old.hedging_budget) != (spec.hedging, spec.hedging_budget):
                self._hedging = _policy(spec)
                self._requests.reconsider()
                log.info("hedging_changed service=%s to=%s", spec.name, spec.hedging.value)
        self._wake()

    def _check(self, ok_field: str) -> Callable[[bytes], bool] | None:
        return self._ok_of(ok_field) if ok_field and self._ok_of is not None else None

    def _accepts(self, payload: bytes) -> bool:
        is_ok = self._is_ok
        return is_ok is None or is_ok(payload)

    def _follow(self, spec: ServiceSpec, fallback: RosClient | None) -> None:
        """Follow what a spec says of fallback and trace."""
        if spec.fallback is not None and self._rescuer is None:
            self._rescuer = Rescuer(
                Shared(
                    spec.name, self._lock, self._requests, self._outcomes, self._accepts,
                    self._clock, self._stop, self._return, self._forget,
                ),
                spec.fallback,
            )  # fmt: skip
        if self._rescuer is not None:
            self._rescuer.follow(spec.fallback, fallback)
        if spec.trace != (self._outcomes.trace is not None):
            self._outcomes.trace = deque(maxlen=_TRACE_KEPT) if spec.trace else None

    def route(self, links: Sequence[Link]) -> None:
        """Set the links that can answer this service now, and offer them what they lack."""
        routed = {key_of(link): link for link in links}
        with self._lock:
            added = [key for key, link in routed.items() if self._links.get(key) is not link]
            self._links, self._able = routed, tuple(routed)
            for replica in added:
                self._requests.came(replica)
        if added:
            self._offer_more(self._clock())

    def tick(self) -> float:
        """Let requests expire, and offer them to whom the policy chooses. Call at 50 Hz.

        Returns:
            When to call again at the latest, on the clock; infinite for no matter when.
        """
        now = self._clock()
        with self._lock:
            expired = self._requests.expire(now)
            for request, pending in expired:
                self._hedging.expired(request, pending.open, now)
                self._pending_bytes -= len(pending.item.payload)
        for request, pending in expired:
            self._expired(request, pending)
        self._offer_more(now)
        with self._lock:
            idle = [request for request, _ in self._requests.idle()]
        for request in idle:
            self._settle(request)
        if self._rescuer is not None:
            look_at = self._rescuer.tick(now, able=bool(self._able))
            self._next_look = min(self._next_look, look_at)
        return self._next_look

    def _offer_more(self, now: float) -> None:
        """Ask the policy about each request that may need a further replica."""
        with self._lock:
            self._hedging.look_at = NEVER
            links = self._links
            full: set[int] = set()
            steps = [
                (request, replica)
                for request, pending in self._in_order(self._requests.short())
                for replica in self._hedging.more(
                    pending.open, self._requests.candidates(pending, self._able, now), now
                )
            ]
            self._next_look = self._hedging.look_at
        for request, replica in steps:
            self._offer(request, replica, links[replica], full)

    def _in_order(self, short: Iterable[_Short]) -> Iterable[_Short]:
        return list(short)[::-1] if self.spec.freshness is Freshness.LATEST else short

    def _offer(self, request: bytes, replica: int, link: Link, full: set[int]) -> None:
        """Offer a request to a replica, unless that declined another one a moment ago."""
        now = self._clock()
        with self._lock:
            wanted = replica not in full
            pending = self._requests.attempt(request, replica, now) if wanted else None
            if pending is None:
                self._hedging.declined(replica, full=not wanted)
                return
            self._outcomes.count["sent"] += 1
            if pending.item.story is not None:
                pending.item.story.asked.setdefault(replica, now)
        remaining_s = pending.deadline - now
        if not link.offer(self.spec.name, request, pending.item.payload, remaining_s):
            full.add(replica)
            self._declined(request, replica)
        elif request not in self._requests:  # it was answered meanwhile
            self._forget(request, (replica,))

    def _expired(self, request: bytes, pending: Pending[Request]) -> None:
        response, rescuer = pending.rejection, self._rescuer
        if rescuer is not None and self.spec.on_timeout is OnTimeout.FALLBACK:
            outcome = "fallback"
        elif response is not None:
            outcome = "answered"
        elif self.spec.on_timeout is OnTimeout.EMPTY and self._empty_response is not None:
            outcome, response = "empty", self._empty_response
        else:
            outcome = "silent"
        if outcome != "fallback":
            with self._lock:
                self._outcomes.count[outcome] += 1
                now = self._clock()
                note_end(self._outcomes, request, pending, outcome=outcome, now=now)
        log.warning(
            "request_timed_out service=%s outcome=%s waited_s=%.3f open=%s request=%s",
            self.spec.name, outcome, self.spec.timeout_s, sorted(pending.open), request.hex(),
        )  # fmt: skip
        if outcome == "fallback" and rescuer is not None:
            rescuer.expired(request, pending)
        elif response is not None:
            self._return(pending.item.handle, response)
        self._forget(request, tuple(self._links))

    def close(self) -> None:
        """It is not used any more."""

    # -- what people see ------------------------------------------------------------------

    def won(self, replica: ReplicaId) -> int:
        """Return how many requests a replica has answered first."""
        return self._outcomes.won_by(replica)

    def by(self, replica: ReplicaId) -> tuple[int, int]:
        """Return how many requests a replica has answered well, and how many failed there."""
        return self._outcomes.by(replica)

    def trace(self) -> list[dict[str, Any]]:
        """Return how requests ended since the last call; none where the spec wants no trace."""
        with self._lock:
            trace = self._outcomes.trace
            if not trace:
                return []
            found = list(trace)
            trace.clear()
        return found

    def report(self) -> dict[str, Any]:
        """Return counters and latency quantiles (seconds; None before the first answer)."""
        with self._lock:
            return {
                **self._outcomes.report(),
                "pending": len(self._requests) + len(self._rescuer or ()),
                "pending_bytes": self._pending_bytes,
                "hedging": self._hedging.report(),
            }


def _policy(spec: ServiceSpec) -> Hedging:
    if spec.hedging is HedgingMode.ADAPTIVE:
        return Adaptive(spec.hedging_budget)
    return Failover() if spec.hedging is HedgingMode.FAILOVER else All()


def key_of(link: Link) -> int:
    """Return a small number for the replica of a link: slot and generation."""
    id = link.peer.id
    return id.slot << 32 | id.generation
