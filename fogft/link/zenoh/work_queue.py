"""A worker thread for what Zenoh's threads must not do themselves.

Owns: what waits for it, and how much may. Not here: what there is to do (`control_queries`,
`fogft.rmw_zenoh`).
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from queue import SimpleQueue

import zenoh

from fogft.link.counters import Counters

log = logging.getLogger(__name__)

LIMIT = 1024  # probes, records and cancellations that wait; a robot has a few on the way


class WorkQueue:
    """A thread that does what it is given, in order. Only `join` blocks."""

    def __init__(self, name: str, counters: Counters) -> None:
        self._counters = counters
        self._queue: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self.add = self._queue.put  # take a job in any case; the collector of garbage may, too
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)

    def __len__(self) -> int:
        return self._queue.qsize()

    def start(self) -> None:
        """Begin. What was given before waits until then."""
        self._thread.start()

    def offer(self, job: Callable[[], None]) -> bool:
        """Take a job, unless too many wait: then count it; return whether it was taken."""
        if len(self) >= LIMIT:
            self._counters.add("control_queries_dropped")
            return False
        self._queue.put(job)
        return True

    def close(self) -> None:
        """Do what waits, then end."""
        self._queue.put(None)

    def join(self, timeout_s: float) -> None:
        """Wait for its end, unless it is the worker that asks."""
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout_s)

    def _work(self) -> None:
        while (job := self._queue.get()) is not None:
            try:
                job()
            except zenoh.ZError as error:  # the session is closed, or who asked is gone
                self._counters.add("failed")
                log.debug("zenoh_refused reason=%r", str(error))
            except Exception:
                self._counters.add("failed")
                log.exception("job_failed thread=%s", self._thread.name)
            finally:
                job = None  # an idle thread must not keep a query open
