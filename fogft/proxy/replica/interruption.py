"""Tell a service to stop what it works on, through the cancel service that it offers.

A cancel service is a `std_srvs/srv/Trigger`: "stop what you are doing". It names no request,
because a ROS service does not know our ids. So a service that has one is given one request at
a time, and nothing more until the cancel service has answered: else what stops might be the
next request. (The two travel apart, in any order.)

Owns: the cancel calls that are under way. Not here: what is unwanted (`responder`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping

from fogft.errors import RosError
from fogft.proxy.replica.service_queue import Job, ServiceQueue
from fogft.ros.port import RosClient

log = logging.getLogger(__name__)

CANCEL_TYPE = "std_srvs/srv/Trigger"
# A serialised message without fields: the header, the byte that stands for no fields, padding.
# Kept true by tests/ros/test_types.py.
EMPTY_REQUEST = bytes((0, 1, 0, 0, 0, 0, 0, 0))
_LIMIT_S = 2.0


class Interruptions:
    """The cancel services of a replica. `send` needs no lock, all else the responder's."""

    def __init__(self) -> None:
        self._clients: Mapping[str, RosClient] = {}
        self._under_way: dict[str, tuple[ServiceQueue, float]] = {}

    def use(self, clients: Mapping[str, RosClient]) -> None:
        """Set the clients of the cancel services, by the service that they interrupt."""
        self._clients = clients

    def begin(self, job: Job, queue: ServiceQueue, now: float) -> bool:
        """Hold the service's next request back; whether there is something to be called."""
        service = job.service
        if service not in self._clients or service in self._under_way or not job.passed_on:
            return False
        queue.at_work += 1
        self._under_way[service] = (queue, now + _LIMIT_S)
        return True

    def send(self, service: str, ended: Callable[[str], None]) -> bool:
        """Call the cancel service; `ended` is called once it has answered."""
        try:
            self._clients[service].call(EMPTY_REQUEST, lambda _: ended(service))
        except (RosError, KeyError) as error:
            log.warning("cancel_not_called service=%s reason=%r", service, str(error))
            ended(service)
            return False
        return True

    def ended(self, service: str) -> None:
        """The cancel service has answered, or died: the next request may go."""
        found = self._under_way.pop(service, None)
        if found is not None:
            found[0].at_work -= 1

    def tick(self, now: float) -> None:
        """Wait no longer for a cancel service that does not answer."""
        for service, (_, until) in list(self._under_way.items()):
            if until <= now:
                log.warning("cancel_unanswered service=%s waited_s=%.1f", service, _LIMIT_S)
                self.ended(service)
