"""One proxied service on the robot: send a request to replicas, return the answer.

`submit` is called by the thread that takes ROS requests and never blocks. Answers arrive on the
links' threads, which must not send: they call `wake`, and the next `tick` sends.

Owns: the life cycle of a request, and a service's policy. Design: docs/design/dispatcher.md.
"""

import logging
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Collection
from typing import Any

from fogft.counters import worth_logging
from fogft.errors import RosError
from fogft.link.credit import LARGE_BYTES
from fogft.link.port import Answer, Link
from fogft.metrics.outcomes import Outcome
from fogft.model.names import REQUEST_ID_BYTES
from fogft.model.refusal import Refusal
from fogft.model.replica import ReplicaId
from fogft.model.spec import HedgingMode, Part, ServiceSpec
from fogft.proxy.robot.delivery import Delivery, Respond
from fogft.proxy.robot.ledger import Ledger
from fogft.proxy.robot.sending import Sender, key_of
from fogft.requests.auto import Auto
from fogft.requests.choose import All, Choose, Failover
from fogft.requests.decide import Accepts, Decide, Means, Pending, Trace
from fogft.requests.load import NEVER
from fogft.requests.pending import LOOK_AGAIN_S, PendingRequests, Verdict
from fogft.ros.port import RosClient

log = logging.getLogger(__name__)

MALFORMED_LIMIT = 3  # malformed responses after which a replica should be replaced
_SHORTEST_S = 0.002
_TICK_S = 0.02
# Delay of cancellations not sent to losers at once, as they were asked, or another cancellation was
# sent, a moment ago (`link.window`).
_TELL_S = 0.1
_PAUSE_S = 1.0  # after this long without requests, no next one is expected


# Schedules a call of `Dispatcher.tick` at the given time or sooner; by default now. Any thread.
Wake = Callable[..., None]


class Dispatcher:
    """The requests of one service, from the caller's request to the caller's response.

    Args:
        decide: Judges answers; by default, the first success wins.
        fault_of: Returns what is wrong with the bytes of a response; empty for nothing. A
            malformed response is a failure of its replica, and another answer is awaited.
        ok_of: Returns, for the name of a boolean response field, a check whether a response is a
            success; used if the spec names an `ok_field`.
        empty_response: The serialised default response, for ``on_timeout: empty``.
        max_pending_bytes: Limit on the bytes of open requests; more are turned away and counted.
        id_of: Returns the id of a caller's request, by service and handle.
        poisoned: Called with the id of each request given up because it crashed services.
    """

    max_pending = 1 << 16  # limit on open requests; more are turned away, too

    def __init__(
        self,
        spec: ServiceSpec,
        respond: Respond,
        *,
        decide: Decide | None = None,
        fault_of: Callable[[bytes], str] = lambda payload: "",
        ok_of: Callable[[str], Accepts] | None = None,
        empty_response: bytes | None = None,
        wake: Wake = lambda at=-NEVER: None,
        clock: Callable[[], float] = time.monotonic,
        max_pending_bytes: int = 256 << 20,
        id_of: Callable[[str, Any], bytes] = lambda service, handle: os.urandom(REQUEST_ID_BYTES),
        poisoned: Callable[[bytes], None] = lambda request: None,
    ) -> None:
        self._id_of, self._poisoned = id_of, poisoned
        self.takes_no_more = False  # another proxy takes callers' requests now
        self.taken: list[bytes] | None = None  # requests taken while another proxy gets them too
        self._fault_of = fault_of
        self._malformed: Counter[int] = Counter()
        self._ok_of = ok_of
        self._wake = wake
        self._asked_at = self._tell_at = self._next_look = NEVER
        self._usual_s = NEVER  # how long after its start a request usually needs a `tick`
        self._clock = clock
        self.max_pending_bytes = max_pending_bytes
        self._decide = Decide() if decide is None else decide
        if spec.ok_field and ok_of is not None:
            self._decide.accept(ok_of(spec.ok_field))
        self._requests = PendingRequests(
            policy(spec),
            self._decide,
            # Requests that wait for a goal to end, or are ordered, are no work of their own.
            counts_deaths=spec.part is Part.NONE and spec.state is None,
        )
        self._ledger = Ledger(spec, self._requests, clock)
        self._lock = self._ledger.lock
        self.outcomes = self._ledger.outcomes
        self._sender = Sender(self._ledger)
        self.route, self.burst = self._sender.route, self._sender.burst
        self._delivery = Delivery(self._ledger, respond, empty_response, self._sender.forget)

    @property
    def spec(self) -> ServiceSpec:
        """The service and its policy."""
        return self._ledger.spec

    @property
    def waiting(self) -> int:
        """The number of unanswered requests."""
        return len(self._requests)

    @property
    def able(self) -> bool:
        """Whether a request that arrives now can be answered."""
        if not self._decide.sends_requests:
            counted = set(self._sender.able).difference(self._decide.flagged)
            return len(counted) >= self._decide.quorum
        with self._lock:  # a thread taking a request may start a term and claim replicas
            return self._decide.ready

    def submit(self, payload: bytes, handle: Any) -> None:
        """Take a caller's request and offer it to the replicas that the policy chooses."""
        spec = self._ledger.spec
        request = self._id_of(spec.name, handle)
        if self._decide.takes_any or not self._answered_here(request, payload, handle):
            self.forward(request, payload, handle, spec.timeout_s)

    def _answered_here(self, request: bytes, payload: bytes, handle: Any) -> bool:
        """Answer a request that no replica may get; return whether it is one."""
        with self._lock:
            answer = None if self.takes_no_more else self._decide.answer_to(request, payload)
            if answer is None:
                return False
            self.outcomes.count["received"] += 1
            now = self._clock()
            pending = Pending(now, payload, handle, now)
            self._ledger.end(request, pending, Outcome.ANSWERED)
        self._delivery.give(pending, answer)
        return True

    def forward(self, request: bytes, payload: bytes, handle: Any, timeout_s: float) -> bool:
        """Like `submit`, for a request with an id and a time-out; return whether it was taken.

        Raises ValueError: A request with this id is in flight.
        """
        now, requests, outcomes = self._clock(), self._requests, self.outcomes
        with self._lock:
            if self.takes_no_more:
                return False
            if self.taken is not None:  # under the same lock as `begin`: `hold` returns no other
                self.taken.append(request)
            count = outcomes.count
            count["received"] += 1
            count["request_bytes"] += len(payload)
            over = requests.held_bytes + len(payload) > self.max_pending_bytes
            if over or requests.size() >= self.max_pending:
                self._turn_away(request, len(payload))
                return False
            links, able = self._sender.links, self._sender.able
            deadline = now + timeout_s
            dear = len(payload) >= LARGE_BYTES and all(link.thin for link in links.values())
            requests.choose.dear = dear
            chosen = requests.begin(
                request, payload, able, deadline=deadline, now=now, handle=handle
            )
            if self._ledger.traced is not None and (pending := requests.get(request)) is not None:
                pending.trace = Trace(dict.fromkeys(chosen, now), {})
            soon = min(requests.choose.look_at, deadline)
            if requests.fallback is not None and self._ledger.spec.fallback is not None:
                requests.fallback.submitted(request, now)
                soon = min(soon, requests.fallback.look_at(able=self.able))
            if requests.size() == 1:
                self._next_look, self._usual_s = soon, soon - now
            self._next_look, self._asked_at = min(self._next_look, soon), now
        taken = self._sender.first(request, payload, links, chosen, timeout_s)
        if self._decide.replicates:
            self._sender.replicate()
        if chosen and not taken:  # all declined, but another replica may take it
            soon = self._next_look = min(self._next_look, now + LOOK_AGAIN_S)
        self._wake(soon)
        return True

    def _turn_away(self, request: bytes, size: int) -> None:
        """Count a request that is not taken. Call under the lock."""
        now, count = self._clock(), self.outcomes.count
        count["turned_away"] += 1
        self._ledger.trace(request, Pending(now, b"", None, now), Outcome.TURNED_AWAY, now)
        if worth_logging(count["turned_away"]):
            held = f"{size} B, beside {self._requests.held_bytes} B of {len(self._requests)}"
            limit = f"at most {self.max_pending_bytes} B and {self.max_pending} requests may wait"
            log.warning("request_turned_away service=%s reason=%r count=%d",
                        self.spec.name, f"{held}: {limit}", count["turned_away"])  # fmt: skip

    def hold(self) -> list[bytes]:
        """Stop ordering requests; return those taken during the hand-over."""
        with self._lock:
            self._decide.hold()
            return list(self.taken or ())

    def take_over(self, taken: Collection[bytes] | None) -> None:
        """Order the held requests, except those the other proxy has taken (None: unknown)."""
        for request in self._decide.held:
            if taken is None or request in taken:
                self.cancel(request)
        with self._lock:
            self._decide.take_over(self._clock())
        self._wake()

    def cancel(self, request: bytes) -> None:
        """Cancel a request; unknown ids are ignored."""
        with self._lock:
            pending = self._requests.stop(request, self._clock())
            self.outcomes.count["cancelled"] += pending is not None
        if pending is not None:
            self._sender.forget(request, tuple(pending.open))

    # -- answers (the links' threads) -----------------------------------------------------

    def answered(self, link: Link, answer: Answer) -> None:
        """Take the end of an attempt from a link's thread."""
        payload, id = answer.payload, link.peer.id
        replica = id.key
        if payload is None:
            self._refused(replica, answer, answer.refusal or Refusal.LOST)
            return
        decide, attempt = self._decide, answer.request_id
        request = decide.request_of(attempt) if decide.replicates else attempt
        try:
            fault = "" if request is None else self._fault_of(payload)
            unread = fault or replica in decide.flagged
            reading = None if unread else decide.takes_any or decide.read(payload)
        except RosError as error:
            fault = error.message
        if fault:  # no response of this type
            self._misread(replica, id, fault)
            self._refused(replica, answer, Refusal.MALFORMED)
            return
        now, outcomes = self._clock(), self.outcomes
        with self._lock:
            means, pending, losers, verdict = self._requests.answered(
                attempt, request, replica, payload, reading, answer.load, now
            )
        if self._requests.choose.news:
            self._wake()
        if pending is not None and request is not None:
            self._delivery.give(pending, payload)  # first: counting can wait
            if losers:
                self._sender.forget(request, losers)
                self._tell_at = min(self._tell_at, now + _TELL_S)
                self._wake(self._tell_at)
            with self._lock:
                outcomes.won(replica, now - pending.arrived, len(payload))
                if self._ledger.traced is not None:
                    self._ledger.trace(request, pending, Outcome.ANSWERED, now, id.short)
        elif means is Means.SUCCESS or means is Means.LATE:
            with self._lock:
                outcomes.of[replica].well += 1
            outcomes.late()
        elif means is Means.UNDECIDED and verdict is Verdict.LATE:
            outcomes.late()
        elif means is Means.REJECTION and request is not None:
            with self._lock:
                outcomes.rejected(replica)
            self._after(request, verdict)
        elif isinstance(means, Refusal):
            if means is Refusal.MALFORMED:
                self._misread(replica, id, "no answer to an order")
            self._failed(replica, request, means)

    def _misread(self, replica: int, id: ReplicaId, fault: str) -> None:
        """Count a malformed response against its replica."""
        with self._lock:
            self._malformed[replica] += 1
            count = self._malformed[replica]
        if worth_logging(count):
            log.error("response_malformed service=%s replica=%s count=%d reason=%r",
                      self.spec.name, id.short, count, fault)  # fmt: skip

    def late(self, link: Link, answer: Answer) -> None:
        """Learn from the end of a cancelled attempt; its payload is not read."""
        worked = answer.payload is not None or answer.refusal is Refusal.LATE
        now, replica, choose = self._clock(), key_of(link), self._requests.choose
        with self._lock:
            if answer.load is not None:
                choose.heard(answer.request_id, replica, answer.load, now)
            choose.late(answer.request_id, replica, now, answered=worked)
        if choose.news:
            self._wake()
        if worked:
            self.outcomes.late()

    def _refused(self, replica: int, answer: Answer, refusal: Refusal) -> None:
        attempt = answer.request_id
        request = self._decide.request_of(attempt)
        with self._lock:
            if answer.load is not None:
                self._requests.choose.heard(attempt, replica, answer.load, self._clock())
            pending = self._requests.get(request)
            self._decide.refused(attempt, replica, refusal, answer.detail, pending)
        self._failed(replica, request, refusal)

    def _failed(self, replica: int, request: bytes | None, refusal: Refusal) -> None:
        now = self._clock()
        with self._lock:
            self.outcomes.refusal(refusal, None if request is None else replica)
            pending = self._requests.get(request)
            if pending is not None and pending.trace is not None:
                pending.trace.refused[replica] = refusal
            if request is None:
                return
            verdict = self._requests.refused(request, replica, refusal, now)
        if verdict is Verdict.POISON:
            self._end_poison(request, now)
        else:
            self._after(request, verdict)

    def _end_poison(self, request: bytes, now: float) -> None:
        """Give up a request that crashed services: only the fallback may still answer it."""
        with self._lock:
            pending = self._requests.give_up(request, now)
        if pending is None:
            return
        log.error(
            "request_poison service=%s type=%s deaths=%d request=%s",
            self.spec.name, self.spec.type, pending.deaths, request.hex(),
        )  # fmt: skip
        self._delivery.poisoned(request, pending)
        self._poisoned(request)
        self._sender.forget(request, tuple(pending.open))

    def _after(self, request: bytes, verdict: Verdict) -> None:
        """If no attempt is open: end the request, or have another replica asked at once."""
        if verdict is Verdict.IDLE and not self._settle(request) and self._requests.choose.moves_on:
            self._wake()

    def _settle(self, request: bytes) -> bool:
        """Return the kept rejection to the caller if no attempt is open and none can be made."""
        with self._lock:
            pending = self._requests.settle(request, self._sender.able)
            if pending is None or pending.rejection is None:
                return False
            self._ledger.end(request, pending, Outcome.ANSWERED)
        self._delivery.give(pending, pending.rejection)
        return True

    # -- policy, links and time -----------------------------------------------------------

    def adopt(self, spec: ServiceSpec, fallback: RosClient | None = None) -> None:
        """Switch to another policy, with a client of its fallback service if it has one.

        Raises RosError: The response has no such `ok_field`; nothing has changed.
        """
        accepts = self._decide.accepts
        if spec.ok_field != self.spec.ok_field and self._ok_of is not None:
            accepts = self._ok_of(spec.ok_field) if spec.ok_field else None
        with self._lock:
            old = self.spec
            self._decide.accept(accepts)
            self._ledger.adopt(spec)
            self._delivery.adopt(spec, fallback)
            if old.hedging is not spec.hedging:
                self._requests.use(policy(spec))
                log.info("hedging_changed service=%s to=%s", spec.name, spec.hedging.value)
        self._wake()

    def began_anew(self, replica: int, about: Callable[[bytes], bool]) -> None:
        """Ask a replica again for requests matching `about`, as it restarted what they await."""
        with self._lock:
            self._requests.welcome(replica, about)
        self._wake()

    def expire(self, *, every: bool = False) -> None:
        """End the requests past their deadline, or `every` request."""
        with self._lock:
            expired = self._requests.expire(self._clock(), every=every)
        for request, pending in expired:
            self._delivery.expired(request, pending, may_fall_back=not every)
            self._sender.forget(request, tuple(self._sender.links))

    def tick(self) -> float:
        """Expire requests, offer others to more replicas; return when to call again at latest."""
        now, self._next_look = self._clock(), NEVER
        if now >= self._tell_at:  # the caller has sent the links' cancellations
            self._tell_at = NEVER
        with self._lock:
            if not self._waits:
                self._requests.choose.news = False  # it concerns no request
                return NEVER
        self.expire()
        look_at = self._sender.offer_more(now)
        self._sender.replicate()
        with self._lock:
            idle = self._requests.idle()
        for request in idle:
            self._settle(request)
        look_at = min(look_at, self._delivery.tick(now, able=self.able))
        look_at = max(min(look_at, self._requests.soonest_deadline), now + _SHORTEST_S)
        if self._decide.replicates:
            look_at = min(look_at, now + _TICK_S)
        with self._lock:
            self._next_look = min(self._next_look, look_at)
        return look_at

    @property
    def _waits(self) -> bool:
        """Whether anything may become due."""
        requests = self._requests
        return bool(requests.size() or requests.fallback or self._decide.replicates)

    def wants_tick(self, now: float) -> tuple[float, float]:
        """Return when `tick` is needed, and when it may be if another request arrives."""
        at = min(self._tell_at, self._next_look) if self._waits else self._tell_at
        return at, min(at, now + self._usual_s) if now < self._asked_at + _PAUSE_S else at

    def close(self) -> None:
        """Release external resources."""
        with self._lock:
            self._decide.close()

    def disagrees(self, replica: int) -> bool:
        """Whether a replica's answers have repeatedly differed from those of others."""
        return replica in self._decide.flagged

    def misreads(self, replica: int) -> bool:
        """Whether a replica's answers were repeatedly malformed."""
        return self._malformed[replica] >= MALFORMED_LIMIT

    def trace(self) -> list[dict[str, Any]]:
        """Return the outcomes since the last call, if traced."""
        with self._lock:
            traced = self._ledger.traced or deque()
            found = list(traced)
            traced.clear()
            return found

    def report(self) -> dict[str, Any]:
        """Return counters and latency quantiles (seconds; None before the first answer)."""
        requests = self._requests
        with self._lock:
            return {
                **self.outcomes.report(),
                "pending": len(requests) + len(requests.fallback or ()),
                "pending_bytes": requests.held_bytes,
                "hedging": requests.choose.report(),
                "needed_replicas": requests.choose.needed(self._sender.able, self._clock()),
                **self._decide.report(),
            }


def policy(spec: ServiceSpec) -> Choose:
    """Return the policy for a service's `hedging` mode."""
    if spec.hedging is HedgingMode.FAILOVER:
        return Failover()
    # If every answer counts, or every replica applies every request, all are asked.
    counts_all = spec.quorum > 1 or spec.state is not None or spec.part is not Part.NONE
    return All() if counts_all or spec.hedging is HedgingMode.ALL else Auto()
