"""The replica's side of its services: run each request once, answer every copy of it.

A cancel service means "stop the running request" and names none, because a ROS service does not
know our ids. So a service with a cancel service gets one request at a time, and no more until the
cancel service has answered: otherwise it might stop the next request.

Owns: the outcome of each request that this replica holds. Not here: known ids (`known_requests`),
the order and number of running requests (`service_queue`).
"""

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial

from fogft.byte_limit import SMALL_BYTES
from fogft.errors import RosError, Unreadable
from fogft.link.port import Incoming
from fogft.model.refusal import Refusal
from fogft.proxy.replica.known_requests import COPIES_LIMIT, KnownRequests
from fogft.proxy.replica.service_queue import Job, ServiceQueue
from fogft.requests.load import Handling
from fogft.ros.port import RosClient
from fogft.topics import goals

log = logging.getLogger(__name__)

# The default depth of a service's queue (rmw_qos_profile_services_default). Kept true by
# tests/proxy/test_processes.py, which sends a burst to an ordinary service.
OUTSTANDING = 10

_TOGETHER_S = 0.005  # answers that follow each other this closely are sent in one message

CANCEL_TYPE = "std_srvs/srv/Trigger"
# A serialised message without fields: the header, a dummy byte for the empty struct, padding.
# Kept true by tests/ros/test_types.py.
EMPTY_REQUEST = bytes((0, 1, 0, 0, 0, 0, 0, 0))


class Responder:
    """Passes requests to the local services, and answers each copy.

    Args:
        limits: Concurrency limits by service; 0 to learn it.
        latest: Services whose newest request goes first.
        results: Services that answer when a goal ends. An answer that the goal is unknown is not
            kept: a copy is run again.
        answered: Called with each request that the service has answered, and when.
    """

    held_limit = 512  # requests held per service; beyond it, the robot with most waiting loses one
    held_bytes = 64 << 20  # total size of large requests; more are refused as overloaded
    outstanding = OUTSTANDING  # requests passed on to one service at once, if no limit is given
    kept_bytes, kept_ids = 16 << 20, 32768  # as for `KnownRequests`

    def __init__(
        self,
        is_ready: Callable[[str], bool],
        *,
        limits: Mapping[str, int] | None = None,
        latest: Collection[str] = (),
        results: Collection[str] = (),
        answered: Callable[[Job, float], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._is_ready = is_ready
        self._limits = dict(limits or {})
        self._latest = frozenset(latest)
        self._results = frozenset(results)
        self._clock, self._answered = clock, answered
        self._lock = threading.Lock()
        self._clients: Mapping[str, RosClient] = {}
        self._cancel_clients: Mapping[str, RosClient] = {}
        self.known = KnownRequests(self.kept_bytes, self.kept_ids, self.held_bytes)
        self._queues: dict[str, ServiceQueue] = {}
        # Requests passed on, and their total time; unwanted ones dropped before they began, or
        # told to stop; run in vain, as they were late or unwanted, and their total time.
        counts = ("ran", "ran_s", "saved", "interrupted", "wasted", "wasted_s")
        self.work: dict[str, float] = dict.fromkeys(counts, 0)

    @property
    def at_work(self) -> int:
        """The number of requests running in the services."""
        return sum(queue.at_work for queue in list(self._queues.values()))

    @property
    def in_flight(self) -> int:
        """The number of unanswered requests."""
        return self.known.held

    def report(self) -> dict[str, float]:
        """Return the counters of requests, in the form of a probe's answer."""
        work = {name: round(count, 3) for name, count in self.work.items()}
        return {"held": self.known.held, **work}

    def hanging(self, *, stuck: bool = False) -> dict[str, float]:
        """Return, for each hanging service, for how many seconds it has finished nothing.

        `stuck`: only those that must be restarted.
        """
        now = self._clock()
        with self._lock:
            return {
                name: queue.quiet_s(now)
                for name, queue in self._queues.items()
                if queue.hangs(now, stuck=stuck)
            }

    @property
    def limits(self) -> dict[str, int]:
        """The concurrency limit of each service."""
        return {name: self._queues[name].limit.limit for name in list(self._queues)}

    def use(
        self,
        clients: Mapping[str, RosClient],
        cancel_clients: Mapping[str, RosClient] | None = None,
    ) -> None:
        """Set the clients of the local services, and of their cancel services, by service."""
        self._clients = clients
        self._cancel_clients = cancel_clients or {}

    # -- from the link --------------------------------------------------------------------

    def request(self, incoming: Incoming) -> None:
        """Take a request from the link. Never blocks."""
        now = self._clock()
        displaced = begun = None
        with self._lock:
            known = self.known.get(incoming.request_id)
            if known is not None:
                if known.waiting is not None and not known.unwanted:
                    known.waiting.append(incoming)
                    del known.waiting[:-COPIES_LIMIT]  # refused as lost: their links are long gone
                    return
                answer = known.answer
                reason: Refusal | None = Refusal.CANCELLED if known.unwanted else Refusal.FORGOTTEN
            else:
                answer = None
                reason, displaced = self._reason_to_refuse(incoming, now)
                if reason is None:
                    job = Job(now, incoming)
                    queue = self._queues[job.service]
                    self.known.add(job)
                    if queue.takes(job):
                        queue.begin(job, now)
                        begun = job
                    else:
                        queue.put(job)
        if displaced is not None:
            self._end(displaced.id, Refusal.OVERLOADED)
        if begun is not None:
            if not self._call(begun):
                self._pass_on(incoming.service)
        elif answer is not None:
            incoming.reply(answer)
        elif reason is not None:
            asked = self._queues.get(incoming.service)
            incoming.refuse(reason, load=None if asked is None else asked.load(0.0))
        else:
            self._pass_on(incoming.service)

    def _queue(self, service: str) -> ServiceQueue:
        queue = self._queues.get(service)
        if queue is None:
            limit, latest = self._limits.get(service) or None, service in self._latest
            queue = self._queues[service] = ServiceQueue(
                self.outstanding, limit, latest=latest, results=service in self._results
            )
        return queue

    def _reason_to_refuse(
        self, incoming: Incoming, now: float
    ) -> tuple[Refusal | None, Job | None]:
        """Return why a request is refused (None if it is not), and the job it displaces."""
        service, remaining_s = incoming.service, incoming.remaining_s
        if remaining_s <= 0:
            return Refusal.EXPIRED, None
        if not self._is_ready(service) or service not in self._clients:
            return Refusal.NOT_READY, None
        queue = self._queues.get(service) or self._queue(service)
        if incoming.handling is Handling.DROP_IF_BUSY and not queue.has_free_slot(now):
            return Refusal.BUSY, None
        deadline = now + remaining_s
        full = queue.waiting() and queue.hopeless(incoming.robot, deadline, remaining_s)
        size = len(incoming.payload)
        large = self.known.large
        if full or (size > SMALL_BYTES and not large.has_room(size, incoming.robot)):
            return Refusal.OVERLOADED, None
        if queue.waiting() + queue.at_work < self.held_limit:
            return None, None
        displaced = queue.evict(incoming.robot, deadline)
        return (Refusal.OVERLOADED if displaced is None else None), displaced

    def cancel(self, ids: Iterable[bytes]) -> None:
        """Cancel requests: drop waiting ones, interrupt running ones. May block."""
        dropped, at_work = [], []
        with self._lock:
            for id in ids:
                job = self.known.get(id)
                if job is None or job.waiting is None or job.unwanted:
                    continue
                job.unwanted = True
                if self._queue(job.service).remove(id):
                    self.work["saved"] += 1
                    dropped.append(id)
                elif job.passed_on:
                    at_work.append(job)
        for id in dropped:
            self._end(id, Refusal.CANCELLED)
        for job in at_work:
            client, queue = self._cancel_clients.get(job.service), self._queues[job.service]
            if client is None:
                continue
            with self._lock:
                held = queue.hold(self._clock()) if job.passed_on else None
            if held is not None:
                self.work["interrupted"] += self._await(job.service, client, EMPTY_REQUEST, held)

    def _await(self, service: str, client: RosClient, request: bytes, held: float) -> bool:
        """Call a service, and end a hold once it answers; return whether the call was sent."""
        try:
            client.call(request, lambda _: self._release(service, held))
        except RosError as error:
            log.warning("service_not_asked service=%s reason=%r", service, str(error))
            self._release(service, held)
            return False
        return True

    def _release(self, service: str, held: float) -> None:
        with self._lock:
            self._queues[service].release(held)  # only this hold: the answer may come late
        self._pass_on(service)

    # -- to the service -------------------------------------------------------------------

    def _pass_on(self, service: str) -> None:
        queue = self._queues[service]
        while True:
            with self._lock:
                job = queue.take(self._clock())
            if job is None:
                return
            if job.passed_on:
                self._call(job)
            else:
                self._end(job.id, Refusal.EXPIRED)

    def _call(self, job: Job) -> bool:
        """Pass a request to the service; return whether ROS took it. If not, it has ended."""
        try:
            payload, job.payload = job.payload, b""
            client = self._clients[job.service]
            job.ticket = client.call(payload, partial(self._finished, job))
        except RosError as error:
            log.warning("request_not_passed_on service=%s reason=%r", job.service, str(error))
            hopeless = isinstance(error, Unreadable)
            self._end(job.id, Refusal.MALFORMED if hopeless else Refusal.OVERLOADED)
        except KeyError:
            self._end(job.id, Refusal.NOT_READY)
        else:
            self.work["ran"] += 1
            if job.service in self._results:
                with self._lock:
                    held = self._queues[job.service].hold_batch(self._clock())
                if held is not None:
                    self._await(job.service, client, goals.RESULT_OF_NONE, held)
            return True
        return False

    def _finished(self, job: Job, payload: bytes) -> None:
        now = self._clock()
        queue = self._queues[job.service]
        with self._lock:
            waiting, job.waiting = job.waiting or [], None
            if waiting:
                # A new replica is asked for a result as soon as it is given the goal.
                passing = job.service in self._results and goals.is_unknown(payload)
                self.known.end(job, None if passing or job.unwanted else payload)
                if passing:
                    self.known.forget(job)
            more = queue.at_work > 1 and queue.limit.service_s < _TOGETHER_S
            load = queue.load(now - job.arrived, ended=1)
        try:
            for incoming in waiting:
                if job.unwanted:  # the robot would drop the answer
                    incoming.refuse(Refusal.LATE, load=load)
                else:
                    incoming.reply(payload, load=load, more=more)
        finally:
            with self._lock:  # after the replies, which are urgent
                queue.finished(job, now)
                self.work["ran_s"] += now - job.begun
                if not waiting or job.unwanted:
                    self.work["wasted"] += 1
                    self.work["wasted_s"] += now - job.begun
            if queue.waiting():
                self._pass_on(job.service)
            if self._answered is not None:
                self._answered(job, now)

    def _end(self, id: bytes, reason: Refusal) -> None:
        """End a job without an answer: a later copy may be run again."""
        with self._lock:
            job = self.known.get(id)
            if job is None or job.waiting is None:
                return
            self.known.end(job)
            if reason is not Refusal.EXPIRED or not job.passed_on:  # else it is still running
                self.known.forget(job)
            waiting, job.waiting = job.waiting, None
            queue = self._queues[job.service]
            queue.remove(id)
            load = queue.load(
                self._clock() - job.arrived, ended=job.passed_on and reason is not Refusal.EXPIRED
            )
            if reason is not Refusal.EXPIRED:
                queue.free(job, taken=job.ticket is not None)
            elif job.passed_on:
                queue.overdue(job, self._clock())
        for incoming in waiting:
            incoming.refuse(reason, load=load)

    def crashed(self, service: str | None = None) -> None:
        """Note that a service, or the whole command, died: refuse its requests."""
        with self._lock:
            dead = self.known.unanswered(service)
            blamed = [job for job in dead if job.passed_on]
            spared = [job for job in dead if not job.passed_on]  # it did not have these yet
            lost = []
            for name, queue in self._queues.items():
                if service in (None, name):
                    lost += queue.abandoned(float("inf"))
                    queue.died()
        for job in (*blamed, *lost):
            self._forget_ticket(job)
        for job in spared:  # first, so that they do not get the slots of the blamed
            self._end(job.id, Refusal.NOT_READY)
        for job in blamed:
            self._end(job.id, Refusal.CRASHED)

    def tick(self) -> None:
        """Refuse requests past their deadline. Call at about 10 Hz."""
        now = self._clock()
        with self._lock:
            late = self.known.expired(now)
            abandoned = [job for queue in self._queues.values() for job in queue.abandoned(now)]
            for name, queue in self._queues.items():
                if queue.held_until <= now:
                    log.warning("service_silent service=%s", name)
                    queue.release()
        for id in late:
            self._end(id, Refusal.EXPIRED)
        for job in abandoned:
            self._forget_ticket(job)
        for service in list(self._queues):
            self._pass_on(service)

    def _forget_ticket(self, job: Job) -> None:
        client = self._clients.get(job.service)
        if client is not None and job.ticket is not None:
            client.forget(job.ticket)
