"""One service on the robot: its dispatcher, and its ROS server while it is offered.

Owns: offering and withdrawing it. Not here: when (`fogft.requests.advertising`).
"""

from __future__ import annotations

import logging

from fogft.errors import RosError
from fogft.model.spec import ServiceSpec
from fogft.proxy.robot.dispatcher import Dispatcher
from fogft.requests.advertising import Advertising
from fogft.ros.port import RosClient, RosNode, RosServer

log = logging.getLogger(__name__)


class ProxiedService:
    """A service of the robot's.

    Attributes:
        trouble: Why it cannot be offered; empty when it can.
    """

    def __init__(self, spec: ServiceSpec, dispatcher: Dispatcher) -> None:
        self.spec = spec
        self.dispatcher = dispatcher
        self.server: RosServer | None = None
        self.fallback: RosClient | None = None
        self.fallback_name = ""
        self.trouble = ""
        self._advertising = Advertising()

    def advertise(self, node: RosNode, now: float) -> None:
        """Offer or withdraw it, as it should be now (monotonic seconds)."""
        able, waiting = self.dispatcher.able, self.dispatcher.waiting
        wanted = self._advertising.wanted(self.spec, able=able, waiting=waiting, now=now)
        if wanted and self.server is None:
            self._offer(node)
        elif not wanted and self.server is not None:
            self._withdraw()

    def _offer(self, node: RosNode) -> None:
        spec = self.spec
        try:
            asked = self.dispatcher
            self.server = node.serve(spec.name, spec.type, asked.submit, asked.burst)
        except RosError as error:  # it shall not take the other services with it
            if self.trouble != error.message:
                self.trouble = error.message
                log.error("service_not_advertised service=%s reason=%r", spec.name, error.message)
        else:
            self.trouble = ""
            log.info("service_advertised service=%s type=%s", spec.name, spec.type)

    def _withdraw(self) -> None:
        server, self.server = self.server, None
        if server is not None:
            server.close()
            log.warning("service_withdrawn service=%s reason='no replica can answer'",
                        self.spec.name)  # fmt: skip

    def close(self) -> None:
        """Withdraw it from ROS, and let go of what its dispatcher holds."""
        for end in (self.server, self.fallback):
            if end is not None:
                end.close()
        self.dispatcher.close()
