"""The queue of a connection's sender thread: in order, or the newest first.

On a thin uplink requests wait here for seconds. Of a service that wants the latest, the newest
takes the turn of the oldest; the others keep waiting, and are sent while their time lasts.
Between services the order is that of arrival.

Owns: the order of sending. Not here: bounds (`window`), sending (`attempts`).
"""

from __future__ import annotations

import heapq
import threading
from collections.abc import Collection
from itertools import count
from queue import SimpleQueue

from fogft.link.window import OpenAttempt

Waiting = list[tuple[float, int, OpenAttempt]]


class SendQueue:
    """A queue of attempts; None ends the sender thread. Any thread."""

    def __init__(self, latest: Collection[str] = ()) -> None:
        self._queued: SimpleQueue[OpenAttempt | str | None] = SimpleQueue()
        self.qsize = self._queued.qsize
        self._lock = threading.Lock()
        self._order = count()
        self._waiting: dict[str, Waiting] = {service: [] for service in latest}

    def overtakes(self, service: str) -> bool:
        """Whether what comes last of a service goes first."""
        return service in self._waiting

    def put(self, attempt: OpenAttempt | None) -> None:
        """Let an attempt wait; None ends the sender when all before it was taken."""
        waiting = self._waiting.get(attempt.service) if attempt is not None else None
        if attempt is None or waiting is None:
            self._queued.put(attempt)
            return
        with self._lock:
            heapq.heappush(waiting, (-attempt.deadline, next(self._order), attempt))
        self._queued.put(attempt.service)

    def get(self) -> OpenAttempt | None:
        """Wait for the next one."""
        turn = self._queued.get()
        if not isinstance(turn, str):
            return turn
        with self._lock:
            return heapq.heappop(self._waiting[turn])[2]

    def stalest(self, than: OpenAttempt) -> OpenAttempt | None:
        """Return what may give way to a newer attempt of its service: the oldest that waits."""
        with self._lock:
            waiting = [entry for entry in self._waiting.get(than.service, ()) if entry[2].payload]
        oldest = max(waiting, default=None)
        return oldest[2] if oldest is not None and oldest[2].deadline < than.deadline else None
