"""A gateway: acts as a replica to its robots, and forwards their requests over its own links.

Owns: which robots' requests are in flight, and who receives each answer.
Design: docs/design/gateways.md.
"""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from queue import SimpleQueue
from typing import Any

from fogft.counters import Counters
from fogft.link.port import Incoming
from fogft.model.refusal import Refusal
from fogft.proxy.replica.known_requests import COPIES_LIMIT, KnownRequests
from fogft.proxy.replica.service_queue import Job
from fogft.proxy.robot.dispatcher import Dispatcher

log = logging.getLogger(__name__)

# Just as long as a link takes to recover by itself.
UNREADY_S = 0.5
_POISON_KEPT = 256  # ids of requests that must not be sent again


class Forwarder:
    """Forwards each request to replicas, and its answer to every robot that awaits it."""

    held_limit = 2048  # requests in flight at once; more are refused as overloaded
    of_one_limit = 512  # the same for one robot, so that none takes all the room
    held_bytes = 256 << 20  # total size of large requests
    kept_bytes = 16 << 20  # total size of answers kept for later copies

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self.dispatchers: dict[str, Dispatcher] = {}  # by service
        self._ready: frozenset[str] = frozenset()
        self._unready_since: dict[str, float] = {}
        self._known = KnownRequests(self.kept_bytes, 4 * self.held_limit, self.held_bytes)
        self._by_robot: Counter[str] = Counter()
        self._poison: deque[bytes] = deque(maxlen=_POISON_KEPT)
        self.queue: SimpleQueue[Job | None] = SimpleQueue()
        self.passed = 0
        self.joined = 0  # copies of requests already known
        self.refused = Counters()

    @property
    def in_flight(self) -> int:
        """Return the number of requests in flight."""
        return self._known.held

    # -- from robots (the link's threads) -------------------------------------------------

    def request(self, incoming: Incoming) -> None:
        """Take a request from the link. Never blocks."""
        answer = reason = None
        with self._lock:
            known = self._known.get(incoming.request_id)
            if known is not None and known.waiting is None and known.answer is None:
                if known.deadline > self._clock():  # the replica still has the answer
                    self._known.forget(known)
                    known = None
                else:  # a late copy
                    reason = Refusal.FORGOTTEN
            if known is None:
                reason = self._reason_to_refuse(incoming)
                if reason is None:
                    job = Job(self._clock(), incoming)
                    self._known.add(job)
                    self._by_robot[job.robot] += 1
                    self.queue.put(job)
                    return
            else:
                self.joined += 1
                answer = known.answer
                if known.waiting is not None:
                    known.waiting.append(incoming)
                    del known.waiting[:-COPIES_LIMIT]  # refused as lost: their links are long gone
        if answer is not None:
            incoming.reply(answer)
        elif reason is not None:
            self._refuse(incoming, reason)

    def _reason_to_refuse(self, incoming: Incoming) -> Refusal | None:
        if incoming.remaining_s <= 0:
            return Refusal.EXPIRED
        if incoming.request_id in self._poison:
            return Refusal.CRASHED
        if incoming.service not in self._ready:
            return Refusal.NOT_READY
        of_robot = self._by_robot[incoming.robot]
        full = self._known.held >= self.held_limit or of_robot >= self.of_one_limit
        too_large = not self._known.large.has_room(len(incoming.payload), incoming.robot)
        return Refusal.OVERLOADED if full or too_large else None

    def _refuse(self, incoming: Incoming, reason: Refusal) -> None:
        self.refused.add(reason.value)
        incoming.refuse(reason)

    def cancel(self, ids: Iterable[bytes]) -> None:
        """Cancel requests, here and at the replicas behind."""
        for id in ids:
            self._stop(id, Refusal.CANCELLED)

    def poisoned(self, id: bytes) -> None:
        """Refuse a request that crashed services, now and whenever it comes again.

        To a robot this is one crash: it does not trust a single gateway, and tries another.
        """
        with self._lock:
            self._poison.append(id)
        self._stop(id, Refusal.CRASHED)

    def _stop(self, id: bytes, reason: Refusal) -> None:
        with self._lock:
            job = self._known.get(id)
            if job is None or job.waiting is None:
                return
            waiting = self._end(job)
            self._known.forget(job)
        self.dispatchers[job.service].cancel(id)
        for incoming in waiting:
            self._refuse(incoming, reason)

    def _end(self, job: Job, answer: bytes | None = None) -> list[Incoming]:
        """End a request; return the copies waiting for its answer. Call under the lock."""
        waiting, job.waiting = job.waiting or [], None
        self._known.end(job, answer)
        self._by_robot[job.robot] -= 1
        if not self._by_robot[job.robot]:
            del self._by_robot[job.robot]
        return waiting

    # -- to replicas ----------------------------------------------------------------------

    def pass_on(self) -> None:
        """Forward the requests taken, until closed."""
        while (job := self.queue.get()) is not None:
            try:
                self._forward(job)
            except Exception:  # nothing else would report it in this thread
                log.exception("request_not_passed_on request=%s", job.id.hex())
                self._stop(job.id, Refusal.LOST)

    def _forward(self, job: Job) -> None:
        if job.waiting is None:
            return  # stopped meanwhile
        payload, job.payload = job.payload, b""
        left_s = job.deadline - self._clock()
        if left_s <= 0:
            self._stop(job.id, Refusal.EXPIRED)
            return
        dispatcher = self.dispatchers[job.service]
        if not dispatcher.forward(job.id, payload, job, left_s):
            self._stop(job.id, Refusal.OVERLOADED)
            return
        self.passed += 1
        if job.waiting is None:
            dispatcher.cancel(job.id)  # stopped meanwhile; if answered, this does nothing

    # -- from replicas (their links' threads) ---------------------------------------------

    def respond(self, handle: Any, payload: bytes) -> None:
        """Send an answer to every waiting copy, and keep it for later copies."""
        job: Job = handle
        with self._lock:
            if job.waiting is None:
                return
            waiting = self._end(job, payload)
            more = self._known.held > 0
        for incoming in waiting:
            incoming.reply(payload, more=more)

    def tick(self, ready: frozenset[str]) -> None:
        """Refuse requests past their deadline or long without a ready replica. Call at 50 Hz."""
        now = self._clock()
        unready, before = self.dispatchers.keys() - ready, self._unready_since
        self._ready, self._unready_since = ready, {n: before.get(n, now) for n in unready}
        hopeless = {n for n, since in self._unready_since.items() if now - since >= UNREADY_S}
        with self._lock:
            late = self._known.expired(now)
            lost = [job.id for job in self._known.unanswered(None) if job.service in hopeless]
        for id in late:
            self._stop(id, Refusal.EXPIRED)
        for id in lost:
            self._stop(id, Refusal.NOT_READY)

    def report(self) -> dict[str, Any]:
        """Return counters since the start."""
        return {
            "in_flight": self.in_flight,
            "passed": self.passed,
            "joined": self.joined,
            "refused": self.refused.snapshot(),
        }

    def work(self) -> dict[str, float]:
        """Return the counters in the form of a probe's answer."""
        refused = self.refused.snapshot()
        return {"held": self.in_flight, "ran": self.passed, "joined": self.joined, **refused}

    def close(self) -> None:
        """Refuse requests in flight, and stop."""
        with self._lock:
            left = self._known.unanswered(None)
        for job in left:
            self._stop(job.id, Refusal.LOST)
        self.queue.put(None)
