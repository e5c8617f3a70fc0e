"""One service on the robot: its dispatcher, and its ROS server while it is offered.

`wait_for_service` in the robot's code is true exactly while it is offered. Requests sent to a
withdrawn service are lost, so a service is not withdrawn during a brief outage, nor while a
request may still be answered.
Owns: which links may be asked.
"""

import logging
from collections.abc import Collection, Sequence

from fogft.errors import RosError
from fogft.link.port import Link
from fogft.model.replica import ReplicaId
from fogft.model.spec import Advertise, Part, ServiceSpec
from fogft.proxy.robot.dispatcher import Dispatcher
from fogft.ros.port import RosClient, RosNode, RosServer

log = logging.getLogger(__name__)

_LOOK_EVERY_S = 2.0  # check for clients with other middleware, and other servers of the service
HOLD_S = 3.0  # longer than it takes to restart the command of a lone replica


class ProxiedService:
    """A proxied service. `trouble`: why it is not offered, or clients get no answers."""

    def __init__(self, spec: ServiceSpec, dispatcher: Dispatcher) -> None:
        self.spec = spec
        self.dispatcher = dispatcher
        self.server: RosServer | None = None
        self._fallback: RosClient | None = None
        self._fallback_name = ""
        self.trouble = ""
        self._wanted = False
        self._unable_since: float | None = None
        self._looked_at = 0.0

    def adopt(self, spec: ServiceSpec, node: RosNode | None) -> None:
        """Apply a policy to the dispatcher, with a client of its fallback service."""
        name = spec.fallback.service if spec.fallback is not None else ""
        if name != self._fallback_name:
            old, self._fallback, self._fallback_name = self._fallback, None, name
            if name and node is not None:
                try:
                    self._fallback = node.client(name, spec.type)
                except RosError as error:
                    log.error("fallback_not_usable service=%s reason=%r", spec.name, error.message)
            if old is not None:
                old.close()
        self.dispatcher.adopt(spec, self._fallback)

    def may_ask(self, links: Sequence[Link], draining: Collection[ReplicaId]) -> list[Link]:
        """Return the links, among those with our type, over which requests may be sent."""
        if self.spec.state is not None:  # replicas become ready by what is sent to them
            return [link for link in links if link.usable]
        ready = [link for link in links if self.spec.name in link.ready]
        if self.spec.part is Part.CANCEL:  # draining replicas get cancellations, but no new work
            return ready
        staying = [link for link in ready if link.peer.id not in draining]
        return staying if len(staying) >= self.spec.quorum else ready

    def advertise(self, node: RosNode, now: float) -> None:
        """Offer or withdraw the service, as required now (monotonic seconds)."""
        self._look_whether_wanted(now)
        if self._wanted and self.server is None:
            self._offer(node)
        elif not self._wanted and self.server is not None:
            server, self.server = self.server, None
            server.close()
            log.warning("service_withdrawn service=%s reason='too few replicas can answer'",
                        self.spec.name)  # fmt: skip
        elif self.server is not None and now > self._looked_at + _LOOK_EVERY_S:
            self._looked_at = now
            self._note("service_disturbed", self.server.mismatch())

    def _look_whether_wanted(self, now: float) -> None:
        spec = self.spec
        at_once = spec.fallback is not None and spec.fallback.while_none_ready
        if self.dispatcher.able or at_once or spec.advertised is Advertise.ALWAYS:
            self._wanted, self._unable_since = True, None
        elif self._wanted and spec.advertised is Advertise.WHILE_READY:
            if self._unable_since is None:
                self._unable_since = now
            limit_s = HOLD_S + (spec.timeout_s if self.dispatcher.waiting else 0.0)
            self._wanted = now < self._unable_since + limit_s

    def _offer(self, node: RosNode) -> None:
        spec = self.spec
        try:
            asked = self.dispatcher
            self.server = node.serve(spec.name, spec.type, asked.submit, asked.burst)
        except RosError as error:  # it must not affect other services
            self._note("service_not_advertised", error.message)
        else:
            self._note("", "")
            log.info("service_advertised service=%s type=%s", spec.name, spec.type)

    def _note(self, event: str, trouble: str) -> None:
        if trouble not in ("", self.trouble):
            log.error("%s service=%s reason=%r", event, self.spec.name, trouble)
        self.trouble = trouble

    def end(self) -> None:
        """Answer open requests as at their deadlines, and close: another takes its place."""
        self.dispatcher.expire(every=True)
        for end in (self.server, self._fallback):
            if end is not None:
                end.close()
        self.dispatcher.close()
