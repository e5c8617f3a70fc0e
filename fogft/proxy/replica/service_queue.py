"""One service's work at a replica: what waits, what was passed on, and how many may be.

In what order requests run is decided here and nowhere else (`take`). Called under the
responder's lock.

Owns: a service's queue, its limit, and the room that is taken.
Not here: request ids and copies (`responder`), the order itself (`requests.admission`).
"""

from __future__ import annotations

from collections import deque

from fogft.link.port import Incoming
from fogft.requests.admission import AdmissionQueue
from fogft.requests.concurrency import ConcurrencyLimit

# Work whose deadline has passed is still in the service's hands and takes its room. After so
# long its response is taken for lost.
_ABANDONED_AFTER_S = 60.0


class Work:
    """A request that was accepted: who waits for it, and its answer once there is one."""

    __slots__ = (
        *("answer", "begun", "deadline", "id", "level", "passed_on", "payload", "robot"),
        *("service", "size", "ticket", "unwanted", "waiting"),
    )

    def __init__(self, deadline: float, first: Incoming) -> None:
        self.id = first.request_id
        self.service = first.service
        self.robot = first.robot
        self.deadline = deadline
        self.payload = first.payload
        self.size = len(first.payload)
        self.passed_on = False
        self.begun = 0.0  # when it was passed on, and
        self.level = 0  # as the how manieth
        self.unwanted = False  # its robot has its answer from elsewhere
        self.waiting: list[Incoming] | None = [first]  # None once it is done
        self.answer: bytes | None = None
        self.ticket: int | None = None


class Line:
    """The work of one service.

    Args:
        most: What the service's own queue holds: never is more passed on, unless `given`.
        given: How many may be at work; None to learn it.
        latest: The newest request goes first.
    """

    def __init__(self, most: int, given: int | None = None, *, latest: bool = False) -> None:
        self._queue: AdmissionQueue[Work] = AdmissionQueue(latest=latest)
        self.limit = ConcurrencyLimit(most, given)
        self.at_work = 0
        self._overdue: deque[tuple[float, Work]] = deque()  # passed on, and past their deadline

    def __len__(self) -> int:
        return len(self._queue)

    def put(self, work: Work) -> None:
        """Let work wait for its turn."""
        self._queue.put(work.id, work.robot, work.deadline, work)

    @property
    def open(self) -> bool:
        """Whether work that comes now is passed on at once: nothing waits, and there is room."""
        return self.at_work < self.limit.limit and not len(self._queue)

    def hopeless(self, robot: str, deadline: float, remaining_s: float) -> bool:
        """Whether a request would wait past its deadline, as far as is known."""
        waiting = len(self._queue)
        if not waiting or self.limit.wait_s(waiting, self.at_work) <= remaining_s:
            return False
        return self.limit.wait_s(self._queue.ahead(robot, deadline), self.at_work) > remaining_s

    def give_way(self, robot: str, deadline: float) -> Work | None:
        """Take out what must go so that a newcomer fits in; None if that must go itself."""
        return self._queue.give_way(robot, deadline)

    def take(self, now: float) -> Work | None:
        """Return what is to be passed on next; None when nothing waits, or nothing more may be.

        What it returns may be past its deadline: then it was not begun and takes no room.
        """
        if self.at_work >= self.limit.limit:
            return None
        work = self._queue.take()
        if work is not None and work.deadline > now:
            self.begin(work, now)
        return work

    def begin(self, work: Work, now: float) -> None:
        """Work is passed on. Work that comes while the line is `open` need not wait before."""
        self.at_work += 1
        work.passed_on, work.begun, work.level = True, now, self.at_work

    def remove(self, work: Work) -> bool:
        """Take work out that waits; whether it did."""
        return self._queue.remove(work.id) is not None

    def finished(self, work: Work, now: float) -> None:
        """The service has answered."""
        if work.passed_on:
            self.limit.finished(work.level, now - work.begun, now)
        self.free(work)

    def free(self, work: Work) -> None:
        """The service has no more to do with this work."""
        if work.passed_on:
            work.passed_on = False
            self.at_work -= 1

    def overdue(self, work: Work, now: float) -> None:
        """Work that was passed on is past its deadline: it keeps its room for a while."""
        self._overdue.append((now + _ABANDONED_AFTER_S, work))

    def abandoned(self, now: float) -> list[Work]:
        """Return the overdue work whose response is taken for lost; its room is free."""
        found = []
        while self._overdue and self._overdue[0][0] <= now:
            work = self._overdue.popleft()[1]
            if work.passed_on:
                found.append(work)
                self.free(work)
        return found
