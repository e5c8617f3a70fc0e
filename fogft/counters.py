"""Count events by name, and log them less often the more they repeat."""

import logging
import threading
from collections import Counter
from collections.abc import Mapping


def worth_logging(count: int) -> bool:
    """Whether to log the `count`-th event of its kind: the 1st, 2nd, 4th, 8th, ..."""
    return count > 0 and count & (count - 1) == 0


class Counters:
    """Counters by event name. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def add(self, event: str, times: int = 1) -> int:
        """Count an event; return how often it has happened."""
        with self._lock:
            count = self._counts[event] = self._counts[event] + times
        return count

    def warn(self, log: logging.Logger, event: str, message: str, *values: object) -> None:
        """Count an event and log it with its count, less often the more it happens."""
        count = self.add(event)
        if worth_logging(count):
            log.warning(f"{message} count=%d", *values, count)

    def snapshot(self) -> Mapping[str, int]:
        """Return all counts."""
        with self._lock:
            return dict(self._counts)
