"""The replica's side of its services: run each request once, answer every copy of it.

A robot that lost its link sends what was in flight again, under the same request id. So
the responder knows each id until its deadline: a copy joins the work in progress, or gets
the kept answer, and is never run again.

At most `OUTSTANDING` requests a service are passed on at a time; the others wait here. An
ordinary ROS service keeps the last ten requests that it has not yet begun and silently
loses more, so what is passed on must never exceed that. What waits here past its deadline
is never begun.

Owns: the requests that this replica holds, and what becomes of them.
Not here: readiness and `run` (`supervisor`), the wire, ROS.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping

from fogft.core.errors import RosError
from fogft.ros.port import RosClient, Unreadable
from fogft.wire.port import Incoming, Refusal

log = logging.getLogger(__name__)

# The default depth of a service's queue (rmw_qos_profile_services_default). Kept true by
# tests/proxy/test_processes.py, which sends a burst to an ordinary service.
OUTSTANDING = 10
# Work whose deadline has passed is still in the service's hands and takes its room. After so
# long its response is taken for lost.
_ABANDONED_AFTER_S = 60.0


class _Work:
    """A request that was accepted: who waits for it, and its answer once there is one."""

    __slots__ = (
        *("answer", "deadline", "id", "passed_on", "payload", "service", "size"),
        *("ticket", "waiting"),
    )

    def __init__(self, id: bytes, service: str, deadline: float, first: Incoming) -> None:
        self.id = id
        self.service = service
        self.deadline = deadline
        self.payload = first.payload
        self.size = len(first.payload)
        self.passed_on = False
        self.waiting: list[Incoming] | None = [first]  # None once it is done
        self.answer: bytes | None = None
        self.ticket: int | None = None


class Responder:
    """Hands requests to the local services and gives each copy its answer.

    Args:
        is_ready: Whether a service can answer now.
        max_in_flight: Requests held at once; more are refused as overloaded.
        held_bytes: Their bytes together; more are refused as overloaded. The robots' windows
            do not bound them: a robot that has its answer from elsewhere frees its window.
        outstanding: Requests passed on to one service at once.
        kept_bytes: Answers kept for copies, in bytes together; the oldest go first.
        kept_ids: Ids known at once; beyond it the oldest finished ones are forgotten.
        clock: Monotonic seconds.
    """

    def __init__(
        self,
        is_ready: Callable[[str], bool],
        *,
        max_in_flight: int = 512,
        held_bytes: int = 64 << 20,
        outstanding: int = OUTSTANDING,
        kept_bytes: int = 16 << 20,
        kept_ids: int = 32768,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._is_ready = is_ready
        self._max_in_flight = max_in_flight
        self._held_bytes_limit = held_bytes
        self._outstanding = outstanding
        self._kept_bytes_limit = kept_bytes
        self._kept_ids = kept_ids
        self._clock = clock
        self._lock = threading.Lock()
        self._clients: Mapping[str, RosClient] = {}
        self._work: OrderedDict[bytes, _Work] = OrderedDict()
        # One queue a service: its requests share a time-out, so the oldest expires first.
        self._deadlines: dict[str, deque[tuple[float, bytes]]] = {}
        self._queues: dict[str, deque[_Work]] = {}
        self._passed_on: dict[str, int] = {}
        self._expired: deque[tuple[float, _Work]] = deque()  # passed on, and late
        self._running = 0
        self._held_bytes = 0
        self._kept_bytes = 0
        self._kept: OrderedDict[bytes, _Work] = OrderedDict()
        self.ran = 0
        self.joined = 0
        self.refused: dict[str, int] = {}

    @property
    def in_flight(self) -> int:
        """Requests that are held and not yet answered."""
        return self._running

    def use(self, clients: Mapping[str, RosClient]) -> None:
        """Set the clients of the local services, by service name."""
        self._clients = clients

    def request(self, incoming: Incoming) -> None:
        """Take a request from the wire. Never blocks."""
        now = self._clock()
        id = incoming.request_id
        with self._lock:
            known = self._work.get(id)
            if known is not None:
                self.joined += 1
                if known.waiting is not None:
                    known.waiting.append(incoming)
                    return
                answer = known.answer
            else:
                reason = self._reason_to_refuse(incoming)
                if not reason:
                    work = _Work(id, incoming.service, now + incoming.remaining_s, incoming)
                    self._work[id] = work
                    self._deadlines.setdefault(work.service, deque()).append((work.deadline, id))
                    self._running += 1
                    self._held_bytes += work.size
                    self._queues.setdefault(work.service, deque()).append(work)
        if known is not None:
            if answer is not None:
                incoming.reply(answer)
            else:
                self._refuse(incoming, Refusal.FORGOTTEN)
        elif reason:
            self._refuse(incoming, reason)
        else:
            self._pass_on(incoming.service)

    def _reason_to_refuse(self, incoming: Incoming) -> str:
        if incoming.remaining_s <= 0:
            return Refusal.EXPIRED
        if not self._is_ready(incoming.service) or incoming.service not in self._clients:
            return Refusal.NOT_READY
        held_bytes = self._held_bytes + len(incoming.payload)
        full = self._running >= self._max_in_flight or held_bytes > self._held_bytes_limit
        if full and self._running:
            return Refusal.OVERLOADED
        return ""

    def _pass_on(self, service: str) -> None:
        """Give a service as much of what waits as it may have."""
        while True:
            with self._lock:
                queue = self._queues.get(service)
                if not queue or self._passed_on.get(service, 0) >= self._outstanding:
                    return
                work = queue.popleft()
                if work.waiting is None:
                    continue  # ended while it waited
                late = work.deadline <= self._clock()
                if not late:
                    work.passed_on = True
                    self._passed_on[service] = self._passed_on.get(service, 0) + 1
            if late:
                self._end(work.id, Refusal.EXPIRED)
            else:
                self._call(work)

    def _call(self, work: _Work) -> None:
        def on_response(payload: bytes) -> None:
            self._finished(work, payload)

        try:
            payload, work.payload = work.payload, b""
            work.ticket = self._clients[work.service].call(payload, on_response)
        except RosError as error:
            log.warning("request_not_passed_on service=%s reason=%r", work.service, str(error))
            hopeless = isinstance(error, Unreadable)
            self._end(work.id, Refusal.MALFORMED if hopeless else Refusal.OVERLOADED)
        except KeyError:
            self._end(work.id, Refusal.NOT_READY)
        else:
            self.ran += 1

    def _finished(self, work: _Work, payload: bytes) -> None:
        with self._lock:
            self._free(work)
            waiting, work.waiting = work.waiting or [], None
            if waiting:
                self._keep(work, payload)
        for incoming in waiting:
            incoming.reply(payload)
        if self._queues[work.service]:
            self._pass_on(work.service)

    def _free(self, work: _Work) -> None:
        """The service has no more to do with this work. Under the lock."""
        if work.passed_on:
            work.passed_on = False
            self._passed_on[work.service] -= 1

    def _keep(self, work: _Work, answer: bytes) -> None:
        """Keep an answer for copies, within the bounds. Under the lock."""
        self._running -= 1
        self._held_bytes -= work.size
        work.answer = answer
        self._kept[work.id] = work
        self._kept_bytes += len(answer)
        while self._kept_bytes > self._kept_bytes_limit and self._kept:
            _, oldest = self._kept.popitem(last=False)
            self._kept_bytes -= len(oldest.answer or b"")
            oldest.answer = None
        if len(self._work) > self._kept_ids:
            self._forget_oldest()

    def _forget_oldest(self) -> None:
        for id, work in self._work.items():
            if work.waiting is None:
                self._drop(id, work)
                return

    def _drop(self, id: bytes, work: _Work) -> None:
        del self._work[id]
        if self._kept.pop(id, None) is not None:
            self._kept_bytes -= len(work.answer or b"")

    def _end(self, id: bytes, reason: str) -> None:
        """End work without an answer: a copy that comes later may be run anew."""
        with self._lock:
            work = self._work.get(id)
            if work is None or work.waiting is None:
                return
            del self._work[id]
            waiting, work.waiting = work.waiting, None
            self._running -= 1
            self._held_bytes -= work.size
            if reason != Refusal.EXPIRED:
                self._free(work)
            elif work.passed_on:
                self._expired.append((self._clock() + _ABANDONED_AFTER_S, work))
        for incoming in waiting:
            self._refuse(incoming, reason)

    def _refuse(self, incoming: Incoming, reason: str) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1
        incoming.refuse(reason)

    def crashed(self, service: str | None = None) -> None:
        """A service, or all with the user's command, has died: refuse what is held for it.

        What it had not been given is not blamed: it was just not ready for that.
        """
        with self._lock:
            dead = [
                work
                for work in self._work.values()
                if work.waiting is not None and service in (None, work.service)
            ]
            blamed = [work for work in dead if work.passed_on]
            spared = [work for work in dead if not work.passed_on]
            abandoned = [entry for entry in self._expired if service in (None, entry[1].service)]
            for entry in abandoned:
                self._expired.remove(entry)
                self._free(entry[1])
        for work in (*blamed, *(work for _, work in abandoned)):
            self._forget_ticket(work)
        for work in spared:  # first: room that the blamed leave is not for them
            self._end(work.id, Refusal.NOT_READY)
        for work in blamed:
            self._end(work.id, Refusal.CRASHED)

    def tick(self) -> None:
        """Drop what is past its deadline. Call at about 10 Hz."""
        now = self._clock()
        late: list[bytes] = []
        with self._lock:
            for queue in self._deadlines.values():
                while queue and queue[0][0] <= now:
                    _, id = queue.popleft()
                    work = self._work.get(id)
                    if work is None or work.deadline > now:
                        continue
                    if work.waiting is None:
                        self._drop(id, work)
                    else:
                        late.append(id)
            abandoned = []
            while self._expired and self._expired[0][0] <= now:
                abandoned.append(self._expired.popleft()[1])
                self._free(abandoned[-1])
        for id in late:
            self._end(id, Refusal.EXPIRED)
        for work in abandoned:
            self._forget_ticket(work)
        for service in list(self._queues):
            self._pass_on(service)

    def _forget_ticket(self, work: _Work | None) -> None:
        client = self._clients.get(work.service) if work else None
        if work is not None and client is not None and work.ticket is not None:
            client.forget(work.ticket)
