"""The replica's side of its services: run each request once, answer every copy of it.

A robot that lost its link sends what was in flight again, under the same request id. So
the responder knows each id until its deadline: a copy joins the work in progress, or gets
the kept answer, and is never run again.

At most `OUTSTANDING` requests a service are passed on at a time; the others wait here. An
ordinary ROS service keeps the last ten requests that it has not yet begun and silently
loses more, so what is passed on must never exceed that. What waits here past its deadline
is never begun, nor what its robot no longer wants.

Owns: the requests that this replica holds, and what becomes of them.
Not here: in what order they run and how many (`service_queue`), readiness and `run` (`supervisor`),
the wire, ROS.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial
from typing import NamedTuple

from fogft.errors import RosError, Unreadable
from fogft.link.port import Incoming
from fogft.model.refusal import Refusal
from fogft.proxy.replica.interruption import Interruptions
from fogft.proxy.replica.service_queue import Line, Work
from fogft.ros.port import RosClient

log = logging.getLogger(__name__)

# The default depth of a service's queue (rmw_qos_profile_services_default). Kept true by
# tests/proxy/test_processes.py, which sends a burst to an ordinary service.
OUTSTANDING = 10
_DEADLINES_KEPT = 1024  # of a service, of work that was forgotten


class Remembered(NamedTuple):
    """How much a `Responder` remembers."""

    requests: int
    deadlines: int
    answers: int  # that copies of their requests would get
    answer_bytes: int


class Responder:
    """Hands requests to the local services and gives each copy its answer.

    Args:
        is_ready: Whether a service can answer now.
        max_in_flight: Requests held at once; more are refused as overloaded, from whom has
            most waiting.
        held_bytes: Their bytes together; more are refused as overloaded. The robots' windows
            do not bound them: a robot that has its answer from elsewhere frees its window.
        outstanding: Requests passed on to one service at once, where no limit is given.
        limits: How many may be at work, by service, where it is not to be learned.
        latest: Services of which the newest request goes first.
        passing: Whether a service's answer holds for the moment only: it is not kept, and a copy
            is run anew.
        kept_bytes: Answers kept for copies, in bytes together; the oldest go first.
        kept_ids: Ids known at once; beyond it the oldest finished ones are forgotten.
        clock: Monotonic seconds.

    Attributes:
        ran: Requests passed on.
        ran_s: The time from then until their responses, together, in seconds.
        joined: Copies of requests that were known.
        saved: Requests that were dropped unbegun because their robot had its answer.
        interrupted: Requests at work that were told to stop for the same reason.
        wasted: Requests that were run for nobody: too late, or no longer wanted.
        wasted_s: The time that they took together, in seconds.
        refused: Refusals by reason.
    """

    def __init__(
        self,
        is_ready: Callable[[str], bool],
        *,
        max_in_flight: int = 512,
        held_bytes: int = 64 << 20,
        outstanding: int = OUTSTANDING,
        limits: Mapping[str, int] | None = None,
        latest: Collection[str] = (),
        passing: Callable[[str, bytes], bool] = lambda service, answer: False,
        kept_bytes: int = 16 << 20,
        kept_ids: int = 32768,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._is_ready = is_ready
        self._max_in_flight = max_in_flight
        self._held_bytes_limit = held_bytes
        self._outstanding = outstanding
        self._limits = dict(limits or {})
        self._latest = frozenset(latest)
        self._passing = passing
        self._kept_bytes_limit = kept_bytes
        self._kept_ids = kept_ids
        self._clock = clock
        self._lock = threading.Lock()
        self._clients: Mapping[str, RosClient] = {}
        self._interruptions = Interruptions()
        self._work: OrderedDict[bytes, Work] = OrderedDict()
        # One queue a service: its requests share a time-out, so the oldest expires first.
        self._deadlines: dict[str, deque[tuple[float, bytes]]] = {}
        self._lines: dict[str, Line] = {}
        self._running = 0
        self._held_bytes = 0
        self._kept_bytes = 0
        self._kept: OrderedDict[bytes, Work] = OrderedDict()
        self.ran = 0
        self.ran_s = 0.0
        self.joined = 0
        self.saved = 0
        self.interrupted = 0
        self.wasted = 0
        self.wasted_s = 0.0
        self.refused: dict[Refusal, int] = {}

    @property
    def in_flight(self) -> int:
        """Requests that are held and not yet answered."""
        return self._running

    def report(self) -> dict[str, float]:
        """Return what became of the work, as a probe's answer tells it."""
        return {
            "held": self._running,
            "ran": self.ran,
            "ran_s": round(self.ran_s, 3),
            "saved": self.saved,
            "interrupted": self.interrupted,
            "wasted": self.wasted,
            "wasted_s": round(self.wasted_s, 3),
            "expired": self.refused.get(Refusal.EXPIRED, 0),
            "overloaded": self.refused.get(Refusal.OVERLOADED, 0),
        }

    @property
    def limits(self) -> dict[str, int]:
        """How many requests each service may have at once."""
        return {name: line.limit.limit for name, line in self._lines.items()}

    def use(
        self,
        clients: Mapping[str, RosClient],
        cancel_clients: Mapping[str, RosClient] | None = None,
    ) -> None:
        """Set the clients of the local services, and of their cancel services, by service."""
        self._clients = clients
        self._interruptions.use(cancel_clients or {})

    # -- from the wire --------------------------------------------------------------------

    def request(self, incoming: Incoming) -> None:
        """Take a request from the wire. Never blocks."""
        now = self._clock()
        id = incoming.request_id
        displaced = begun = None
        with self._lock:
            known = self._work.get(id)
            if known is not None:
                self.joined += 1
                if known.waiting is not None and not known.unwanted:
                    known.waiting.append(incoming)
                    return
                answer = known.answer
                reason: Refusal | None = Refusal.CANCELLED if known.unwanted else Refusal.FORGOTTEN
            else:
                answer = None
                reason, displaced = self._reason_to_refuse(incoming, now)
                if reason is None:
                    begun = self._accept(incoming, now)
        if displaced is not None:
            self._end(displaced.id, Refusal.OVERLOADED)
        if begun is not None:
            if not self._call(begun):
                self._pass_on(incoming.service)
        elif answer is not None:
            incoming.reply(answer)
        elif reason is not None:
            self._refuse(incoming, reason)
        else:
            self._pass_on(incoming.service)

    def _accept(self, incoming: Incoming, now: float) -> Work | None:
        """Take a request; return it where it is to be passed on at once."""
        work = Work(now + incoming.remaining_s, incoming)
        service = work.service
        line = self._lines[service]
        self._work[work.id] = work
        deadlines = self._deadlines.get(service)
        if deadlines is None:
            deadlines = self._deadlines[service] = deque()
        deadlines.append((work.deadline, work.id))
        if len(deadlines) > 2 * len(self._work) + _DEADLINES_KEPT:
            self._deadlines[service] = self._live(deadlines)
        self._running += 1
        self._held_bytes += work.size
        if line.open:
            line.begin(work, now)
            return work
        line.put(work)
        return None

    def _live(self, deadlines: deque[tuple[float, bytes]]) -> deque[tuple[float, bytes]]:
        """Return the deadlines without those of work that was forgotten or run anew."""
        live = ((due, self._work.get(due[1])) for due in deadlines)
        return deque(due for due, work in live if work is not None and work.deadline == due[0])

    def _line(self, service: str) -> Line:
        line = self._lines.get(service)
        if line is None:
            line = self._lines[service] = Line(
                self._outstanding, self._limits.get(service), latest=service in self._latest
            )
        return line

    def _reason_to_refuse(
        self, incoming: Incoming, now: float
    ) -> tuple[Refusal | None, Work | None]:
        """Return why a request is not taken, None if it is, and what gives way to it."""
        service, remaining_s = incoming.service, incoming.remaining_s
        if remaining_s <= 0:
            return Refusal.EXPIRED, None
        if not self._is_ready(service) or service not in self._clients:
            return Refusal.NOT_READY, None
        line = self._line(service)
        deadline = now + remaining_s
        if not line.open and line.hopeless(incoming.robot, deadline, remaining_s):
            return Refusal.OVERLOADED, None
        held_bytes = self._held_bytes + len(incoming.payload)
        if held_bytes > self._held_bytes_limit and self._running:
            return Refusal.OVERLOADED, None
        if self._running < self._max_in_flight:
            return None, None
        displaced = line.give_way(incoming.robot, deadline)
        return (None, displaced) if displaced is not None else (Refusal.OVERLOADED, None)

    def cancel(self, ids: Iterable[bytes]) -> None:
        """Drop requests that are no longer wanted; those at work are told to stop, if they can.

        Not for a thread that must not block: a cancel service is called.
        """
        dropped, at_work = [], []
        with self._lock:
            for id in ids:
                work = self._work.get(id)
                if work is None or work.waiting is None or work.unwanted:
                    continue
                work.unwanted = True
                if self._line(work.service).remove(work):
                    self.saved += 1
                    dropped.append(id)
                elif work.passed_on:
                    at_work.append(work)
        for id in dropped:
            self._end(id, Refusal.CANCELLED)
        for work in at_work:
            line = self._lines[work.service]
            with self._lock:
                held = self._interruptions.begin(work, line, self._clock())
            if held and self._interruptions.send(work.service, self._interrupted):
                self.interrupted += 1

    def _interrupted(self, service: str) -> None:
        with self._lock:
            self._interruptions.ended(service)
        self._pass_on(service)

    # -- to the service -------------------------------------------------------------------

    def _pass_on(self, service: str) -> None:
        """Give a service as much of what waits as it may have."""
        line = self._lines[service]
        while True:
            with self._lock:
                work = line.take(self._clock())
            if work is None:
                return
            if work.passed_on:
                self._call(work)
            else:
                self._end(work.id, Refusal.EXPIRED)

    def _call(self, work: Work) -> bool:
        """Give the service a request; return whether it was taken. If not, it has ended."""
        try:
            payload, work.payload = work.payload, b""
            on_response = partial(self._finished, work)
            work.ticket = self._clients[work.service].call(payload, on_response)
        except RosError as error:
            log.warning("request_not_passed_on service=%s reason=%r", work.service, str(error))
            hopeless = isinstance(error, Unreadable)
            self._end(work.id, Refusal.MALFORMED if hopeless else Refusal.OVERLOADED)
        except KeyError:
            self._end(work.id, Refusal.NOT_READY)
        else:
            self.ran += 1
            return True
        return False

    @property
    def remembered(self) -> Remembered:
        """How much of requests is remembered, answered ones included."""
        with self._lock:
            deadlines = sum(map(len, self._deadlines.values()))
            return Remembered(len(self._work), deadlines, len(self._kept), self._kept_bytes)

    def _finished(self, work: Work, payload: bytes) -> None:
        now = self._clock()
        line = self._lines[work.service]
        with self._lock:
            waiting, work.waiting = work.waiting or [], None
            if waiting and self._passing(work.service, payload):
                self._work.pop(work.id, None)
            elif waiting and not work.unwanted:
                self._keep(work, payload)
            if waiting:
                self._running -= 1
                self._held_bytes -= work.size
            more = line.at_work > 1
        try:
            for incoming in waiting:
                if work.unwanted:  # its bytes would be dropped at the other end
                    self._refuse(incoming, Refusal.LATE)
                else:
                    incoming.reply(payload, more=more)
        finally:
            self._over(work, line, now, wasted=not waiting or work.unwanted)

    def _over(self, work: Work, line: Line, now: float, *, wasted: bool) -> None:
        """Give the room of finished work to what waits. After its replies: these cannot wait."""
        with self._lock:
            line.finished(work, now)
            self.ran_s += now - work.begun
            if wasted:
                self.wasted += 1
                self.wasted_s += now - work.begun
        if line:
            self._pass_on(work.service)

    def _keep(self, work: Work, answer: bytes) -> None:
        """Keep an answer for copies, within the bounds. Under the lock."""
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

    def _drop(self, id: bytes, work: Work) -> None:
        del self._work[id]
        if self._kept.pop(id, None) is not None:
            self._kept_bytes -= len(work.answer or b"")

    def _end(self, id: bytes, reason: Refusal) -> None:
        """End work without an answer: a copy that comes later may be run anew."""
        with self._lock:
            work = self._work.get(id)
            if work is None or work.waiting is None:
                return
            del self._work[id]
            waiting, work.waiting = work.waiting, None
            self._running -= 1
            self._held_bytes -= work.size
            line = self._lines[work.service]
            line.remove(work)
            if reason is not Refusal.EXPIRED:
                line.free(work)
            elif work.passed_on:
                line.overdue(work, self._clock())
        for incoming in waiting:
            self._refuse(incoming, reason)

    def _refuse(self, incoming: Incoming, reason: Refusal) -> None:
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
            lost = []
            for name, line in self._lines.items():
                if service in (None, name):
                    lost += line.abandoned(float("inf"))
                    self._interruptions.ended(name)
        for work in (*blamed, *lost):
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
            abandoned = [work for line in self._lines.values() for work in line.abandoned(now)]
            self._interruptions.tick(now)
        for id in late:
            self._end(id, Refusal.EXPIRED)
        for work in abandoned:
            self._forget_ticket(work)
        for service in list(self._lines):
            self._pass_on(service)

    def _forget_ticket(self, work: Work) -> None:
        client = self._clients.get(work.service)
        if client is not None and work.ticket is not None:
            client.forget(work.ticket)
