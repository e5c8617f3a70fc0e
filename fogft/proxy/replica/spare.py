"""The user's command with a second process of it that is warm: it takes over when the first dies.

Both run in ROS domains of their own, so that nothing asks the spare one. When the first dies, the
proxy leaves its domain and joins that of the other.

Owns: which of the two is at work. Not here: one process (`supervisor`), joining ROS (`server`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from fogft.cloud.local.reservations import Reservation
from fogft.proxy.replica.supervisor import Supervisor

log = logging.getLogger(__name__)


class WithSpare:
    """Two processes of one command, used as one `Supervisor`. Main thread only.

    Args:
        reserved: The second ROS domain.
        settled: Whether the one at work is ready. The spare one is started only then: two that
            start at once would both take twice as long.
    """

    def __init__(
        self,
        at_work: Supervisor,
        spare: Supervisor,
        settled: Callable[[], bool],
        reserved: Reservation,
    ) -> None:
        self._at_work, self._spare = at_work, spare
        self._settled = settled
        self._reserved = reserved  # the second domain is ours while this is kept

    @property
    def domain_id(self) -> int | None:
        """The ROS domain of the process at work."""
        return self._at_work.domain_id

    @property
    def alive(self) -> bool:
        """Whether the one at work runs."""
        return self._at_work.alive

    @property
    def restarts(self) -> int:
        """How often either was started again."""
        return max(self._at_work.restarts, 0) + max(self._spare.restarts, 0)

    @property
    def last_exit(self) -> str:
        """How the one at work ended the last time."""
        return self._at_work.last_exit

    def poll(self, *, at_work: bool = False) -> bool:
        """See whether the one at work died; if so, the spare one takes its place.

        Args:
            at_work: As for `Supervisor.poll`.

        Returns:
            Whether it has died since the last call.
        """
        died = self._at_work.poll(at_work=at_work)
        if self._spare.alive or self._settled():
            self._spare.poll()
        if died and self._spare.alive:
            self._at_work, self._spare = self._spare, self._at_work
            log.info("spare_takes_over domain=%s", self.domain_id)
        return died

    def restart(self) -> None:
        """End the one at work at once; `poll` notes its death."""
        self._at_work.restart()

    def stop(self) -> None:
        """End both. Repeatable."""
        self._spare.stop()
        self._at_work.stop()
