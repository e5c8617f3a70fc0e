"""Our log on `/rosout`: records go to a node's rclpy logger, with their level.

Any thread may log, also one that must not block: a record is only put into a bounded queue,
and the node's own thread passes it on. Standard error has every record in any case.

Owns: that queue, and the node's level, which ours follow.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from typing import Any

log = logging.getLogger(__name__)

OURS = "fogft"  # the logger above all of ours
LIMIT = 1000


class RosLog(logging.Handler):
    """Passes what our loggers are told on to a node's logger, from the moment it is made.

    Args:
        logger: The node's. Its level becomes ours; whoever changes it later changes ours.
        wake: Has `pass_on` called soon. Any thread.
    """

    def __init__(self, logger: Any, wake: Callable[[], None]) -> None:
        super().__init__()
        self._logger = logger
        self._wake = wake
        self._waiting: deque[logging.LogRecord] = deque()
        self._dropped = 0
        ours = logging.getLogger(OURS)
        logger.set_level(_severity(ours.getEffectiveLevel()))
        self._level: int = int(logger.get_effective_level())
        ours.addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record for `pass_on`."""
        if len(self._waiting) >= LIMIT:
            self._dropped += 1
            return
        self._waiting.append(record)
        self._wake()

    def pass_on(self) -> None:
        """Tell the node's logger what waits, and follow its level. The node's thread."""
        while self._waiting:
            self._tell(self._waiting.popleft())
        if self._dropped:
            dropped, self._dropped = self._dropped, 0
            self._logger.warning(f"log_records_dropped count={dropped}")
        level = int(self._logger.get_effective_level())
        if level != self._level:
            self._level = level
            logging.getLogger(OURS).setLevel(level)
            log.warning("log_level_changed to=%s", logging.getLevelName(level))

    def _tell(self, record: logging.LogRecord) -> None:
        try:
            text = self.format(record)
        except Exception:  # a message that does not go with its arguments
            self.handleError(record)
            return
        # rclpy knows a line of code by its level: each has a line of its own.
        if record.levelno >= logging.CRITICAL:
            self._logger.fatal(text)
        elif record.levelno >= logging.ERROR:
            self._logger.error(text)
        elif record.levelno >= logging.WARNING:
            self._logger.warning(text)
        elif record.levelno >= logging.INFO:
            self._logger.info(text)
        else:
            self._logger.debug(text)

    def close(self) -> None:
        """Take no more records. Repeatable."""
        logging.getLogger(OURS).removeHandler(self)
        super().close()


def _severity(level: int) -> int:
    """Return rclpy's severity for a level; the numbers are the same."""
    return max(logging.DEBUG, min(logging.CRITICAL, level // 10 * 10))
