"""The jobs of one service at a replica: waiting ones, running ones, and the concurrency limit.

Only this module decides which request runs next, and when (`take`). Called under the
responder's lock. Not here: the queue's order (`requests.fair_queue`).
"""

from collections import deque

from fogft.link.port import Incoming
from fogft.model.keys import LONGEST_S
from fogft.requests.concurrency import ConcurrencyLimit
from fogft.requests.fair_queue import FairQueue
from fogft.requests.load import NEARLY, NEVER, Handling, Load

# A running job past its deadline is still in the service and keeps its slot. After this long its
# response counts as lost.
_ABANDONED_AFTER_S = 60.0
# A service hangs if it has work but has finished none for this long, and for this many times its
# recent longest. One that has never finished any may still be loading.
_HANGS_AFTER_S = 1.0
_HANGS_AFTER_TIMES = 5.0
# After this long it is restarted, if all its work is past the deadline; one alone may be lost.
_STUCK_AFTER_S = 60.0
_STUCK_AFTER_TIMES = 20.0
_STUCK_ON = 2
LONGEST_FADES = 0.999  # with each answer
# While others wait, a job begins only with this many usual service times left, or, if less, this
# share of the longest time-out given here: otherwise it would often end too late.
_TAKES_TIMES, _TAKES_SHARE = 3.0, 0.25
HOLD_LIMIT_S = 2.0  # a cancel service that has not answered by then is given up
# An action server answers a result request when its goal ends, and its queue keeps only the last
# ten that it has not taken. So it gets a batch of this many, then one that it answers at once.
_BATCH = 8
_BATCH_LIMIT_S = 60.0  # it may be busy with a goal, and take nothing meanwhile


def most_quiet_s(longest_s: float, *, stuck: bool = False) -> float:
    """Return how long a service may finish nothing, given its recent longest service time."""
    if stuck:
        return max(_STUCK_AFTER_S, _STUCK_AFTER_TIMES * longest_s)
    return max(_HANGS_AFTER_S, _HANGS_AFTER_TIMES * longest_s)


class Job:
    """An accepted request: its callers, and its answer once there is one."""

    __slots__ = (
        *("alone", "answer", "arrived", "begun", "deadline", "id", "level", "passed_on"),
        *("payload", "robot", "service", "size", "spare", "ticket", "unwanted", "waiting"),
    )

    def __init__(self, arrived: float, first: Incoming) -> None:
        self.id = first.request_id
        self.service = first.service
        self.robot = first.robot
        self.arrived = arrived
        self.deadline = arrived + first.remaining_s
        self.payload = first.payload
        self.size = len(first.payload)
        self.alone = first.handling is Handling.ALONE
        self.spare = first.handling is Handling.DROP_IF_BUSY
        self.passed_on = False
        self.begun = 0.0  # when it was passed on
        self.level = 0  # how many were running then, itself included
        self.unwanted = False  # its robot has cancelled it
        self.waiting: list[Incoming] | None = [first]  # copies to answer; None once it is done
        self.answer: bytes | None = None
        self.ticket: int | None = None


class ServiceQueue:
    """The jobs of one service.

    Args:
        most: The size of the service's own queue: the most that is passed on, unless `given`.
        given: The concurrency limit; None to learn it.
        results: Whether the service is an action's `get_result`.
    """

    def __init__(
        self,
        most: int,
        given: int | None = None,
        *,
        latest: bool = False,
        results: bool = False,
    ) -> None:
        self._waiting: FairQueue[Job] = FairQueue(latest=latest)
        self.waiting = self._waiting.size  # how many
        self.remove = self._waiting.remove  # return a waiting job, by its id; None if it is not one
        self.evict = self._waiting.evict  # remove a job to make room for a new one
        self.limit = ConcurrencyLimit(most, given)
        self.at_work = 0
        self._begun_last = 0.0
        self._alone = False  # the running job must have no other beside it
        self._next: Job | None = None  # passed on above the limit: the service has not begun it
        self._longest_s = 0.0  # recent longest service time; 0 before the first answer
        self._longest_given_s = 0.0  # recent longest time-out of a request
        self._quiet_since: float | None = None  # since when it has work but has finished none
        self._unanswered = 0  # jobs passed on and not answered, whether or not they have a slot
        self._last_deadline = 0.0
        self.held_until = NEVER  # during a `hold`: when it ends at the latest
        self._batch = 0  # jobs passed on since the service was known to have taken all
        self._batch_limit = _BATCH if results else NEVER
        self._overdue: deque[tuple[float, Job]] = deque()  # running jobs past their deadline

    def put(self, job: Job) -> None:
        """Queue a job."""
        # A spare copy, which waits for a job that is nearly done, goes after all first copies.
        deadline = job.deadline + (LONGEST_S if job.spare else 0.0)
        self._waiting.put(job.id, job.robot, deadline, job)
        given_s = job.deadline - job.arrived
        self._longest_given_s = max(given_s, self._longest_given_s * LONGEST_FADES)

    def _has_room(self, job: Job) -> bool:
        if self.at_work and (job.alone or self._alone or self._batch >= self._batch_limit):
            return False
        return self.at_work < (self.limit.limit if job.spare else self.limit.in_hand)

    def has_free_slot(self, now: float) -> bool:
        """Whether nothing waits, and the service can start one more job (almost) at once."""
        if self.waiting() or self._alone:
            return False
        nearly_over = now - self._begun_last >= NEARLY * self.limit.takes_s > 0.0
        return self.at_work < max(1, self.limit.known) or (self.at_work == 1 and nearly_over)

    def takes(self, job: Job) -> bool:
        """Whether a job that arrives now is passed on at once."""
        return not self.waiting() and (not self.at_work or self._has_room(job))

    def load(self, spent_s: float, *, ended: int = 0) -> Load | None:
        """Return the load after `ended` jobs ended just now; None until service time is known.

        `spent_s`: how long the request that is being answered was here.
        """
        if not self.limit.service_s:
            return None
        waiting, running = self.waiting(), self.at_work - ended
        limit = self.limit
        # `Load(...)` would cost one more Python call.
        return tuple.__new__(Load, (waiting, running, limit.known, limit.service_s, spent_s))

    def hopeless(self, robot: str, deadline: float, remaining_s: float) -> bool:
        """Whether a request is expected to wait past its deadline, given those that wait."""
        if self.limit.wait_s(self.waiting(), self.at_work) <= remaining_s:
            return False
        return self.limit.wait_s(self._waiting.ahead(robot, deadline), self.at_work) > remaining_s

    def take(self, now: float) -> Job | None:
        """Return the next job to pass on; None if none waits or the limit is reached.

        The job may be past its deadline, or too close to it to finish in time: then it has not
        begun and takes no slot.
        """
        if not self.waiting() or self.at_work >= self.limit.in_hand or self._alone:
            return None
        job = self._waiting.take()
        if job is not None and not self._has_room(job):
            self._waiting.not_served(job.robot)
            self.put(job)  # until the service has nothing else to do
            return None
        takes_s = self.limit.takes_s
        needs_s = takes_s if self.at_work >= self.limit.limit else 0.0
        if self.waiting():
            most_s = _TAKES_SHARE * self._longest_given_s
            needs_s += max(takes_s, min(_TAKES_TIMES * takes_s, most_s))
        if job is not None:
            if job.deadline > now + needs_s:
                self.begin(job, now)
            else:
                self._waiting.not_served(job.robot)
        return job

    def begin(self, job: Job, now: float) -> None:
        """Note that a job is passed on."""
        self.at_work += 1
        self._batch += 1
        self._alone = job.alone
        self._unanswered += 1
        self._last_deadline = max(self._last_deadline, job.deadline)
        if self._quiet_since is None:
            self._quiet_since = now
        self._begun_last = now
        job.passed_on, job.begun, job.level = True, now, self.at_work
        if self.at_work > self.limit.limit:
            self._next = job

    def finished(self, job: Job, now: float) -> None:
        """Note that the service has answered."""
        if job.passed_on:
            took_s = now - job.begun
            self.limit.finished(job.level, took_s, now)
            self._longest_s = max(took_s, self._longest_s * LONGEST_FADES)
        self.free(job)
        if self._next is not None:  # the service begins it only now
            self._next.begun, self._next.level = now, self.at_work
            self._begun_last, self._next = now, None
        self._unanswered = self.at_work - (self.held_until < NEVER)  # a hold is no request
        self._quiet_since = now if self._unanswered else None

    def free(self, job: Job, *, taken: bool = True) -> None:
        """Free a job's slot: the service is done with it, or never got it (`taken` is False)."""
        if job is self._next:
            self._next = None
        if job.passed_on:
            job.passed_on = False
            self.at_work -= 1
            self._batch = max(0, self._batch - (not taken)) if self.at_work else 0
            self._alone = False
            self._unanswered -= 1
            if not self._unanswered:
                self._quiet_since = None

    def hold(self, now: float, limit_s: float = HOLD_LIMIT_S) -> float | None:
        """Begin no job until `release`; return the time limit, or None if already on hold."""
        if self.held_until < NEVER:
            return None
        self.at_work += 1
        self.held_until = now + limit_s
        return self.held_until

    def hold_batch(self, now: float) -> float | None:
        """If a batch is full, `hold` until the action server is known to have taken it."""
        return self.hold(now, _BATCH_LIMIT_S) if self._batch >= self._batch_limit else None

    def release(self, until: float | None = None) -> None:
        """End a `hold`, if there is one; with `until`, only that hold."""
        if self.held_until < NEVER and until in (None, self.held_until):
            self.held_until = NEVER
            self.at_work -= 1
            self._batch = 0

    def hangs(self, now: float, *, stuck: bool) -> bool:
        """Whether it is quiet for unusually long; `stuck`: even longer, with no caller waiting."""
        if stuck and (self._unanswered < _STUCK_ON or now < self._last_deadline):
            return False
        return self.quiet_s(now) > most_quiet_s(self._longest_s, stuck=stuck)

    def quiet_s(self, now: float) -> float:
        """Return how long it has had work and finished none; 0 if it has never answered."""
        if self._quiet_since is None or not self._longest_s:
            return 0.0
        return now - self._quiet_since

    def died(self) -> None:
        """Forget what was learned about the service's process, because it died."""
        self.release()
        self._quiet_since, self._unanswered, self._next, self._batch = None, 0, None, 0
        self._longest_s = self._last_deadline = 0.0

    def overdue(self, job: Job, now: float) -> None:
        """Note that a running job is past its deadline; it keeps its slot for a while."""
        self._overdue.append((now + _ABANDONED_AFTER_S, job))

    def abandoned(self, now: float) -> list[Job]:
        """Return the overdue jobs whose response counts as lost; their slots are free."""
        found = []
        while self._overdue and self._overdue[0][0] <= now:
            job = self._overdue.popleft()[1]
            if job.passed_on:
                found.append(job)
                self._unanswered += 1  # it still is: undo what `free` subtracts
                self.free(job)
        return found
