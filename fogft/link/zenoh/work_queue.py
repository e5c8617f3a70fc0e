"""One more thread for what Zenoh's threads must not do, ahead of all replies.

Owns: what waits for it, and how much may. Not here: what there is to do (`asides`).
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from queue import SimpleQueue

from fogft.link.counters import Counters

log = logging.getLogger(__name__)

LIMIT = 1024  # probes, records and recalls that wait; a robot has a few on the way


class Chores:
    """A thread that does what it is given, in order. Nothing here blocks.

    Args:
        counters: Count ``chores_dropped`` and ``failed``.
    """

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._queue: SimpleQueue[Callable[[], None] | None] = SimpleQueue()

    def __len__(self) -> int:
        return self._queue.qsize()

    def start(self) -> None:
        """Begin. What was given before waits until then."""
        threading.Thread(target=self._work, name="fogft-probes", daemon=True).start()

    def offer(self, chore: Callable[[], None]) -> bool:
        """Take a chore, unless too many wait: then count it; return whether it was taken."""
        if len(self) >= LIMIT:
            self._counters.add("chores_dropped")
            return False
        self._queue.put(chore)
        return True

    def add(self, chore: Callable[[], None]) -> None:
        """Take a chore in any case. The collector of garbage may call this, too."""
        self._queue.put(chore)

    def close(self) -> None:
        """Do what waits, then end."""
        self._queue.put(None)

    def _work(self) -> None:
        while (chore := self._queue.get()) is not None:
            try:
                chore()
            except Exception:
                self._counters.add("failed")
                log.exception("chore_failed")
