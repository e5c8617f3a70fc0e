"""The server proxy: passes requests from the link to the replica's local services.

When the command dies, the proxy leaves ROS and rejoins: discovery would still list the dead
service. When a service disappears but the command lives, the requests it had are refused.

Owns: the replica's state as reported to probes. Design: docs/design/server-proxy.md.
"""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import TYPE_CHECKING, Any, cast

from fogft import __version__
from fogft.cloud.notice_formats import Notice, NoticeKind
from fogft.errors import RosError
from fogft.link.port import Incoming, Probe, ProbeAnswer
from fogft.model import names
from fogft.model.choices import Freshness
from fogft.model.refusal import Refusal
from fogft.model.replica import ReplicaId
from fogft.model.spec import Part, ServiceSpec
from fogft.model.topic import TopicSpec
from fogft.model.type_definition import Definition
from fogft.proxy.replica.goals_once import GoalsOnce
from fogft.proxy.replica.offering import Offering
from fogft.proxy.replica.ordered_responder import Clients, OrderedResponder
from fogft.proxy.replica.responder import CANCEL_TYPE, Responder
from fogft.proxy.replica.service_queue import Job
from fogft.proxy.replica.serving_lease import HeldLease
from fogft.proxy.replica.supervisor import Supervisor
from fogft.proxy.replica.topics import TopicsOnReplica
from fogft.records.record import Record
from fogft.ros.joining import Pauses
from fogft.ros.port import RosClient, RosNode
from fogft.ros.state_bytes import StateBytes

if TYPE_CHECKING:
    from fogft.link.zenoh.replica.listener import ZenohListener
    from fogft.ros.node import SerialisedNode

log = logging.getLogger(__name__)

_STRANGERS = ("handshakes_refused", "unauthenticated", "kept_out")
_LOOK_EVERY_S = 0.15  # interval of checking services while all are ready


class ServerProxy:
    """The server proxy of one replica.

    Args:
        services: The services to offer; if empty, whatever the command offers.
        make_node: Joins ROS; called again after each death of the command.
        spare: A second process of the command, which takes over when the first dies.
        define: Returns the local definition of a type, for the robot to compare.
        topics: The topics to forward; these need nodes that publish and subscribe.
        answered: As for `Responder`.
    """

    def __init__(
        self,
        id: ReplicaId,
        services: tuple[ServiceSpec, ...],
        listener: ZenohListener,
        make_node: Callable[[], RosNode],
        command: Supervisor,
        *,
        spare: Supervisor | None = None,
        define: Callable[[str], Definition] = lambda name: Definition(),
        topics: tuple[TopicSpec, ...] = (),
        answered: Callable[[Job, float], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._id = id
        self._keys = partial(names.service_keys, id.pool_uid, id.slot)
        types = tuple(topic.type for topic in topics)
        self._offering = Offering(services, define, clock, types)
        self._not_usable: dict[str, str] = {}  # service -> why it cannot be called; "" if it can
        self._listener, self._make_node = listener, make_node
        self.endpoint = listener.endpoint  # ``host:port`` at which it listens
        self.revoke = listener.revoke  # deny access to these certificates
        self.command, self._spare = command, spare  # the active process, and the spare one
        self._clock, self._look_at = clock, 0.0
        self._pauses = Pauses()
        self._lease = HeldLease(clock)
        self._topics = TopicsOnReplica(topics, clock)
        self._incarnation = secrets.token_hex(8)
        self.ready: frozenset[str] = frozenset()  # services that can answer now
        self._node: RosNode | None = None
        self._clients: dict[str, RosClient] = {}
        self._servers: dict[str, int] = {}
        self._ordered: dict[str, OrderedResponder] = {}
        for service in services:
            if service.state is not None:
                state = StateBytes(service.state)
                self._ordered[service.name] = OrderedResponder(service.name, state, clock)
        self.draining = self._at_risk = False  # set by notices from the cloud
        self.responder = Responder(
            lambda name: name in self.ready,
            # A cancel service names no request, so only one may be running.
            limits={s.name: 1 if s.cancel else s.concurrency for s in services},
            latest=[s.name for s in services if s.freshness is Freshness.LATEST],
            results=[s.name for s in services if s.part is Part.RESULT],
            answered=answered,
            clock=clock,
        )
        self._goals = GoalsOnce(
            [s.name for s in services if s.part is Part.GOAL],
            lambda name: name in self.ready,
            clock,
        )

    def start(self) -> None:
        """Start listening, and start the user's command."""
        types = {service.name: service.type for service in self._offering.services}
        keys = self._keys(types | self._topics.types)
        self._join_ros()
        # With only plain services, requests go straight to the responder: no dispatch cost.
        chosen = self._ordered or self._topics or self._goals
        request = self._request if chosen else self.responder.request
        self._listener.serve(keys, request, self._probe, self.responder.cancel)
        self._poll()
        log.info("replica_listening replica=%s endpoint=%s", self._id, self._listener.endpoint)

    def run_once(self) -> None:
        """Supervise the command, readiness and deadlines. Call at about 10 Hz."""
        lease = self._listener.lease()
        self.renew(() if lease is None else (lease.record,))
        died, stopped = self._poll(), self._pauses.was_long()
        if died or stopped or self._node is None or not self._node.alive:
            self.ready = frozenset()
            if died:
                self._goals.crashed()
            self._crashed()
            self._leave_ros()
            self._join_ros()
        self._take_up_new()
        now = self._clock()
        if not self.complete or now >= self._look_at:
            self._look_at = now + _LOOK_EVERY_S
            self._look_for_services()
            if self._node is not None:
                self._node.look()
        self._end_stuck()
        self.responder.tick()
        self._goals.tick()
        self._topics.tick()
        for ordered in self._ordered.values():
            ordered.tick(self.command.alive)

    def _poll(self) -> bool:
        """Return whether the command died; restart it, or have the spare process take over."""
        died = self.command.poll(at_work=self.responder.at_work > 0)
        spare = self._spare
        # Start it only once this replica is ready: starting two at once takes both twice as long.
        if spare is not None and (spare.alive or self.complete):
            spare.poll()
        if died and spare is not None and spare.alive:
            self.command, self._spare = spare, self.command
            log.info("spare_takes_over domain=%s", spare.domain_id)
        return died

    @property
    def _restarts(self) -> int:
        return sum(max(one.restarts, 0) for one in (self.command, self._spare) if one is not None)

    def _take_up_new(self) -> None:
        if self._node is None or not self.command.alive:
            self._offering.reset()
            return
        for service in self._offering.look(self._node, complete=self.complete):
            name, type_name = service.name, service.type
            log.info("service_found replica=%s service=%s type=%s", self._id, name, type_name)
            self._make_client(self._node, service)
            self._listener.add(self._keys({name: type_name}))

    def _crashed(self) -> None:
        self.responder.crashed()
        for ordered in self._ordered.values():
            ordered.crashed()

    def _look_for_services(self) -> None:
        there = {name for name, client in self._clients.items() if self._can_call(name, client)}
        ready = frozenset(there if self.command.alive else ())
        gone = self.ready - ready
        if ready != self.ready:
            log.info("services_ready replica=%s ready=%s", self._id, sorted(ready))
            self.ready = ready
        before, self._servers = self._servers, {n: c.servers() for n, c in self._clients.items()}
        # One more server than before means that one died and was replaced: it stays listed long.
        replaced = {n for n, count in self._servers.items() if 0 < before.get(n, 0) < count}
        for name in gone | replaced:
            log.warning("service_lost replica=%s service=%s", self._id, name)
            if name in self._ordered and self.command.alive:
                self.command.restart()  # its state is unknown
            else:
                self._goals.crashed(name)
                self.responder.crashed(name)

    def _can_call(self, name: str, client: RosClient) -> bool:
        known = client.is_known()  # always call it: it probes the servers, which takes time
        if not client.available():
            return False
        self._note(name, client.mismatch())
        return known and not self._not_usable.get(name)

    def _note(self, name: str, trouble: str) -> None:
        """Record, and log once, why a service cannot be called here; empty if it can."""
        if trouble not in ("", self._not_usable.get(name)):
            log.error("service_not_usable replica=%s service=%s reason=%r", self._id, name, trouble)
        self._not_usable[name] = trouble

    def _end_stuck(self) -> None:
        """Restart the command if one of its services is stuck."""
        for name, seconds in self._hanging(stuck=True).items():
            log.error("service_stuck replica=%s service=%s quiet_s=%.0f", self._id, name, seconds)
            self.command.restart()
            return

    def _hanging(self, *, stuck: bool = False) -> dict[str, float]:
        """Return the hanging services; not parts of actions, which take as long as their goals."""
        hanging = self.responder.hanging(stuck=stuck)
        quiet = {name: one.quiet_s(stuck=stuck) for name, one in self._ordered.items()}
        hanging |= {name: seconds for name, seconds in quiet.items() if seconds}
        if not hanging:
            return hanging
        plain = {s.name for s in self._offering.services if s.part is Part.NONE}
        return {name: seconds for name, seconds in hanging.items() if name in plain}

    @property
    def complete(self) -> bool:
        """Whether all services can be called here."""
        return len(self.ready) == len(self._offering.services) > 0

    @property
    def idle(self) -> bool:
        """Whether all services can answer, and nothing needs frequent checks."""
        return self.complete and not (self._topics or self._goals or self._ordered)

    def renew(self, records: Iterable[Record]) -> None:
        """Take the manager's signed leases; only a newer one has an effect."""
        for record in records:
            self._lease.renew(record)

    @property
    def lease_is_over(self) -> bool:
        """Whether the lease has expired, because no manager renewed it."""
        left_s = self._lease.left_s
        return left_s is not None and left_s <= 0

    def noticed(self, notice: Notice) -> None:
        """Take a preemption or rebalance notice for this machine. Any thread; never withdrawn."""
        if notice.kind is NoticeKind.PREEMPTION:
            self.draining = True
        else:
            self._at_risk = True

    def report(self) -> dict[str, Any]:
        """Return counters and state, for metrics."""
        answering = self._answering()
        return {
            "work": self._work(),
            "limits": self.responder.limits,
            "refused": dict(self._listener.refusals()),
            "services": {s.name: s.name in answering for s in self._offering.services},
            "draining": self.draining,
            "lease_left_s": self._lease.left_s,
            "restarts": self._restarts,
            "wire": dict(self._listener.counters()),
        }

    def _join_ros(self) -> None:
        node = self._node = self._make_node()
        self._clients = {}
        self._servers = {}
        if self._topics:
            self._topics.use(cast("SerialisedNode", node))
        services = self._offering.services
        for service in services:
            self._make_client(node, service)
        cancels = {s.name: node.client(s.cancel, CANCEL_TYPE) for s in services if s.cancel}
        self.responder.use(self._clients, cancels)
        self._goals.use(self._clients)
        for service in services:
            made = service.name in self._clients and service.name in self._ordered
            if made and service.state is not None:
                ends = (service.state.snapshot, service.state.restore)
                snapshot, restore = (node.client(end.name, end.type) for end in ends)
                clients = Clients(self._clients[service.name], snapshot, restore)
                self._ordered[service.name].use(clients)

    def _make_client(self, node: RosNode, service: ServiceSpec) -> None:
        """Create a service's client. Without its type the replica goes on, and reports why."""
        try:
            self._clients[service.name] = node.client(service.name, service.type)
        except RosError as error:
            self._note(service.name, error.message)
        else:
            self._note(service.name, "")

    def _leave_ros(self) -> None:
        node, self._node, self._clients = self._node, None, {}
        self.responder.use({})
        self._goals.left_ros()
        self._goals.use({})
        self._topics.use(None)
        for ordered in self._ordered.values():
            ordered.use(None)
        if node is not None:
            node.close()

    def _request(self, incoming: Incoming) -> None:
        name = incoming.service
        if name in self._topics:
            self._topics.request(incoming)
        elif name in self._goals:
            self._goals.request(incoming)
        else:
            (self._ordered.get(name) or self.responder).request(incoming)

    def _answering(self) -> frozenset[str]:
        """Return the services that can answer: found and, if stateful, with the current state."""
        if not self._ordered:
            return self.ready
        return self.ready - {name for name, one in self._ordered.items() if not one.ready}

    def _work(self) -> dict[str, float]:
        refused = self._listener.refusals()
        told = {
            why.value: refused.get(why.value, 0) for why in (Refusal.EXPIRED, Refusal.OVERLOADED)
        }
        return {**self.responder.report(), **told}

    def _probe(self, probe: Probe) -> ProbeAnswer:
        counts = self._listener.counters()
        topics = self._topics.ready() if self._topics and self.command.alive else frozenset()
        return ProbeAnswer(
            slot=self._id.slot,
            generation=self._id.generation,
            incarnation=self._incarnation,
            ready=self._answering() | topics,
            draining=self.draining,
            at_risk=self._at_risk,
            restarts=self._restarts,
            in_flight=self.responder.in_flight
            + self._goals.in_flight
            + sum(ordered.in_flight for ordered in self._ordered.values()),
            detail=self._detail(),
            work=self._work(),
            offered=self._offering.told(self.ready),
            types=self._offering.types() if probe.describe else {},
            hanging=frozenset(self._hanging()),
            version=__version__,
            lease_age_s=self._lease.age_s,
            lease_left_s=self._lease.left_s,
            strangers=sum(counts.get(event, 0) for event in _STRANGERS),
        )

    def _detail(self) -> str:
        if self.complete:
            return self._detail_of_complete()
        for why in filter(None, self._not_usable.values()):
            return why
        if self._topics.trouble:
            return self._topics.trouble
        if not self.command.alive:
            if not self.command.last_exit:
                return "`run` has not started"
            return f"`run` {self.command.last_exit}: see `fogft logs {self._id.slot}`"
        return self._offering.missing(self.ready)

    def _detail_of_complete(self) -> str:
        for name, ordered in self._ordered.items():
            if not ordered.ready:
                why = "" if ordered.complete else ": `run` does not offer its snapshot or restore"
                return ordered.detail or f"`{name}` does not have the current state yet{why}"
        for name, seconds in () if self._topics.trouble else self._hanging().items():
            return f"`{name}` has requests and has answered none for {seconds:.0f} s"
        return self._topics.trouble

    def close(self) -> None:
        """Stop the command, and close the link and the ROS node."""
        self.ready = frozenset()
        for command in filter(None, (self._spare, self.command)):
            command.stop()
        self._goals.crashed()
        self._crashed()
        self._listener.close()
        self._leave_ros()
        self._topics.close()
