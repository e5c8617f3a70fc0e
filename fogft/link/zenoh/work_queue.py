"""A worker thread for jobs that Zenoh's threads must not do themselves."""

import logging
import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from queue import SimpleQueue

import zenoh

from fogft.counters import Counters

log = logging.getLogger(__name__)

LIMIT = 256  # jobs queued per lane; a robot has only a few in flight
LANES_LIMIT = 256


class WorkQueue:
    """A thread that runs jobs: round-robin over lanes, in order within one. Only `join` blocks."""

    def __init__(self, name: str, counters: Counters) -> None:
        self._counters = counters
        self._queue: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self.add = self._queue.put  # queue a job unconditionally; the garbage collector may call it
        self._lock = threading.Lock()
        self._lanes: dict[bytes, deque[Callable[[], None]]] = {}  # none is empty
        self._closing = False
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self.start = self._thread.start  # jobs queued before it wait

    def offer(self, job: Callable[[], None], lane: bytes = b"", *, always: bool = False) -> bool:
        """Queue a job; if its lane is full, or too many lanes exist, count it and return False."""
        with self._lock:
            waiting = self._lanes.get(lane)
            if waiting is not None and len(waiting) < LIMIT:
                waiting.append(job)
                return True
            room = always or len(self._lanes) < LANES_LIMIT
            if waiting is None and room and not self._closing:
                self._lanes[lane] = deque((job,))
                self._queue.put(partial(self._next, lane))
                return True
        self._counters.add("control_queries_dropped")
        return False

    def _next(self, lane: bytes) -> None:
        """Run a lane's oldest job; its next one is queued behind those of other lanes."""
        with self._lock:
            waiting = self._lanes[lane]
            job = waiting.popleft()
            if waiting:
                self._queue.put(partial(self._next, lane))
            else:
                del self._lanes[lane]
        job()

    def close(self) -> None:
        """Run the queued jobs, then end."""
        self._closing = True
        self._queue.put(None)

    def join(self, timeout_s: float) -> None:
        """Wait for the thread to end, unless called by it."""
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout_s)

    def _work(self) -> None:
        while (job := self._queue.get()) is not None or self._lanes:
            if job is None:  # end only after the jobs that wait
                self._queue.put(None)
                continue
            try:
                job()
            except zenoh.ZError as error:  # the session is closed, or the sender is gone
                self._counters.add("failed")
                log.debug("zenoh_refused reason=%r", str(error))
            except Exception:
                self._counters.add("failed")
                log.exception("job_failed thread=%s", self._thread.name)
            finally:
                job = None  # an idle thread must not keep a query open
