"""Requests known to a replica or gateway: each id once, its answer kept for a while. Pure.

A robot that lost its link resends the requests in flight, under the same ids, and a copy on a slow
uplink comes late. So an id is kept beyond its deadline, and its answer is kept for copies until
then, as long as there is room. Called under the owner's lock.
"""

import heapq
from collections import OrderedDict

from fogft.byte_limit import SMALL_BYTES, ByteLimit
from fogft.proxy.replica.service_queue import Job

COPIES_LIMIT = 8  # copies of one request waiting for its answer, one per reopened link
_COPIES_COME_S = 120.0  # a copy on a slow uplink can arrive this long after the deadline
_DEADLINES_KEPT = 1024  # deadlines of forgotten jobs that are not worth cleaning up


class KnownRequests:
    """The open jobs, and at most `kept_ids` recently answered ones.

    Args:
        kept_bytes: Total size of answers kept for copies; the oldest are dropped first.
        kept_ids: Limit on known ids; beyond it, the oldest finished ones are forgotten.
        held_bytes: Limit on the total size of large requests of open jobs.
    """

    def __init__(self, kept_bytes: int, kept_ids: int, held_bytes: int) -> None:
        self._kept_bytes_limit = kept_bytes
        self._kept_ids = kept_ids
        self._jobs: OrderedDict[bytes, Job] = OrderedDict()
        self.get = self._jobs.get  # return a known job by its id
        self._deadlines: list[tuple[float, bytes]] = []  # a heap
        self._kept: OrderedDict[bytes, Job] = OrderedDict()
        self._kept_bytes = 0
        self.held = 0  # how many jobs are open
        self.large = ByteLimit(held_bytes)

    def __len__(self) -> int:
        """Return the number of entries: requests, including answered ones, and deadlines."""
        return len(self._jobs) + len(self._deadlines)

    def unanswered(self, service: str | None) -> list[Job]:
        """Return the jobs that a caller waits for, of one service or of all."""
        return [
            job
            for job in self._jobs.values()
            if job.waiting is not None and service in (None, job.service)
        ]

    def add(self, job: Job) -> None:
        """Add a new job."""
        if len(self._jobs) >= self._kept_ids:
            oldest_done = next((job for job in self._jobs.values() if job.waiting is None), None)
            if oldest_done is not None:
                self.forget(oldest_done)
        self._jobs[job.id] = job
        heapq.heappush(self._deadlines, (job.deadline, job.id))
        if len(self._deadlines) > 2 * len(self._jobs) + _DEADLINES_KEPT:
            # Drop the deadlines of jobs that were forgotten or run again.
            live = ((due, self._jobs.get(due[1])) for due in self._deadlines)
            self._deadlines = [due for due, job in live if job and job.deadline <= due[0]]
            heapq.heapify(self._deadlines)
        self.held += 1
        if job.size > SMALL_BYTES:
            self.large.add(job.size, job.robot)

    def end(self, job: Job, answer: bytes | None = None) -> None:
        """Note that a job is done; its answer is kept for copies, within the bounds."""
        self.held -= 1
        if job.size > SMALL_BYTES:
            self.large.remove(job.size, job.robot)
        if answer is None:
            return
        job.answer = answer
        self._kept[job.id] = job
        self._kept_bytes += len(answer)
        while self._kept_bytes > self._kept_bytes_limit and self._kept:
            _, oldest = self._kept.popitem(last=False)
            self._kept_bytes -= len(oldest.answer or b"")
            oldest.answer = None

    def forget(self, job: Job) -> None:
        """Forget a finished job, so that a copy is run again."""
        del self._jobs[job.id]
        self._drop_answer(job)

    def _drop_answer(self, job: Job) -> None:
        if self._kept.pop(job.id, None) is not None:
            self._kept_bytes -= len(job.answer or b"")
            job.answer = None

    def expired(self, now: float) -> list[bytes]:
        """Forget jobs long past their deadline; return ids past it that a caller waits for."""
        late = []
        while self._deadlines and self._deadlines[0][0] <= now:
            due, id = heapq.heappop(self._deadlines)
            job = self._jobs.get(id)
            if job is None or job.deadline > now:
                continue
            if job.waiting is not None:
                late.append(id)
            elif due < job.deadline + _COPIES_COME_S:
                heapq.heappush(self._deadlines, (job.deadline + _COPIES_COME_S, id))
                self._jobs.move_to_end(id, last=False)  # the first to make room
                self._drop_answer(job)
            else:
                self.forget(job)
        return late
