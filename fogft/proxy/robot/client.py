"""The client proxy: the robot's side of every proxied service.

Owns: the services, and routing each to its links.
Not here: the links themselves (`links`), files and signals (`process`), requests (`dispatcher`).
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from typing import TYPE_CHECKING, Any

from fogft.errors import RosError
from fogft.link.port import Answer, Dialer, GatewayView, Link
from fogft.model import names
from fogft.model.replica import Membership, ReplicaId
from fogft.model.spec import HedgingMode, ServiceSpec
from fogft.model.topic import TopicSpec
from fogft.model.type_definition import Definition
from fogft.process import Wakeup
from fogft.proxy.robot.dispatcher import Dispatcher, Wake
from fogft.proxy.robot.links import Define, Links, TypeCheck, best_of, link_report, seen_through
from fogft.proxy.robot.proxied_service import ProxiedService
from fogft.proxy.robot.sending import key_of
from fogft.proxy.robot.topics import Merge, TopicsOnRobot
from fogft.requests.load import NEVER
from fogft.ros.port import RosNode

if TYPE_CHECKING:
    from fogft.ros.node import SerialisedNode

log = logging.getLogger(__name__)

_TICK_S = 0.02  # if there are topics
_IDLE_TICK_S = 0.1


@dataclass(eq=False)
class ClientProxy:
    """Sends each request to the replicas that its policy chooses; returns the first success.

    Args:
        node: The ROS node on the robot; None in a gateway, which gets requests over links.
        define: Returns the local definition of a type; unknown ones are not compared.
        merge: Merges the statuses that replicas report for an action into one.
    """

    pool_uid: str
    node: RosNode | None
    dialer: Dialer
    # Creates the dispatcher of a service, given how to respond and how to have `tick` called soon.
    make_dispatcher: Callable[[ServiceSpec, Callable[[Any, bytes], None], Wake], Dispatcher]
    _: KW_ONLY
    clock: Callable[[], float] = time.monotonic
    define: Define = lambda name: Definition()
    merge: Merge = lambda said: None

    def __post_init__(self) -> None:
        self._type_check = TypeCheck(self.define)
        self.tell = self.dialer.tell  # signed records, for every replica
        self._lock = threading.RLock()
        self._services: dict[str, ProxiedService] = {}
        self.links = Links(self.dialer, self, self._keys)
        self._version = (0, 0)
        self._membership: Membership | None = None
        self._through_gateways = False
        self._topics = TopicsOnRobot(self._wake, self.merge, self.clock)
        # When the thread of `run_once` next wakes by itself; `_wake` makes it sooner.
        self._sleeps_until = NEVER
        self._sooner = Wakeup()
        self._look_now = self._changed = False
        self._advertise_at = -NEVER

    def serve(self, specs: Iterable[ServiceSpec]) -> None:
        """Proxy exactly these services. Requests in flight continue.

        Raises RosError: One cannot be proxied (a stateful one has ended); all others are updated.
        """
        failure: RosError | None = None
        with self._lock:
            wanted = {spec.name: spec for spec in specs}
            for name in [n for n in self._services if n not in wanted]:
                self._services.pop(name).end()
            keys_changed = False
            for spec in wanted.values():
                try:
                    keys_changed |= self._serve_one(spec)
                except RosError as error:
                    failure = failure or error
            if keys_changed:
                self.links.redial()
        self.look_again()
        if failure is not None:
            raise failure

    def _serve_one(self, spec: ServiceSpec) -> bool:
        """Proxy a service, or update its policy; return whether its keys at replicas may change."""
        old = self._services.get(spec.name)
        if old is not None and _kind(old.spec) == _kind(spec):
            old.spec = spec
            self._adopt(old)
            return False
        if old is not None and old.spec.state is not None:  # two would write the same mark
            old.end()
            del self._services[spec.name]
            old = None
        self._services[spec.name] = self._new_service(spec)
        if old is not None:
            old.end()
        return True

    def pass_topics(self, topics: Iterable[TopicSpec], node: SerialisedNode) -> None:
        """Forward exactly these topics; `node` publishes and subscribes on the robot."""
        with self._lock:
            if self._topics.serve(topics, node):
                self.links.redial()
        self.look_again()

    def _new_service(self, spec: ServiceSpec) -> ProxiedService:
        service: ProxiedService

        def respond(handle: Any, payload: bytes) -> None:
            if service.server is not None:
                service.server.respond(handle, payload)

        dispatcher = self.make_dispatcher(self._here(spec), respond, self._wake)
        service = ProxiedService(spec, dispatcher)
        if spec.fallback is not None:
            self._adopt(service)
        return service

    def _adopt(self, service: ProxiedService) -> None:
        service.adopt(self._here(service.spec), self.node)

    def _here(self, spec: ServiceSpec) -> ServiceSpec:
        """Return the policy to apply here: through gateways, a request goes to one, not to all."""
        if self._through_gateways:
            return replace(spec, hedging=HedgingMode.FAILOVER)
        return spec

    # -- membership -----------------------------------------------------------------------

    def follow(self, membership: Membership) -> bool:
        """Keep one link to each member. Refuse an older membership, or another pool's."""
        version = (membership.epoch, membership.version)
        with self._lock:
            if membership.pool_uid != self.pool_uid or version < self._version:
                log.warning("membership_refused version=%s have=%s", version, self._version)
                return False
            self._version = version
            self._membership = membership
            good = (m for m in membership.members if m.certificate_name not in membership.revoked)
            members = {m.id: m for m in good}
            own = self.dialer.certificate()
            if own in membership.revoked:  # then no replica may be contacted
                log.error("robot_revoked certificate=%s", own)
                members = {}
            through = any(member.gateway for member in members.values())
            if through != self._through_gateways:
                self._through_gateways = through
                for service in self._services.values():
                    self._adopt(service)
            for link in self.links:
                if link.peer.id not in members:
                    self._drop(link.peer.id)
            for member in members.values():
                self.links.reach(member)
        self.look_again()
        return True

    def renew(self) -> None:
        """Switch to new credentials, link by link; no request is lost."""
        self.dialer.renew()
        if self._membership is not None:
            self.follow(self._membership)  # the old credentials may have been revoked
        log.info("credentials_renewed")

    def redial(self) -> None:
        """Redial all replicas over other uplinks; requests in flight are sent again."""
        with self._lock:
            self.links.redial()
        self.look_again()

    def _keys(self, slot: int) -> dict[str, str]:
        return names.service_keys(self.pool_uid, slot, self._types())

    def _types(self) -> dict[str, str]:
        """Return the type of each service and topic, by its name on the link."""
        types = {name: service.spec.type for name, service in self._services.items()}
        return types | self._topics.types()

    def _drop(self, id: ReplicaId) -> None:
        link = self.links.remove(id)
        self._type_check.forget(id)
        self._route()  # before closing it: requests open there end as LOST
        link.close()

    # -- events of links (their threads) --------------------------------------------------

    def answered(self, link: Link, answer: Answer) -> None:
        """Pass the end of an attempt to the service of its request."""
        service = self._services.get(answer.service)
        if service is not None:
            service.dispatcher.answered(link, answer)
        else:
            self._topics.answered(key_of(link), answer)

    def changed(self, link: Link) -> None:
        """Wake `run_once`, which computes routes; a link's thread must not."""
        self.look_again()

    def late(self, link: Link, answer: Answer) -> None:
        """Pass the end of a cancelled attempt to the service of its request."""
        found = self._services.get(answer.service)
        if found is not None:
            found.dispatcher.late(link, answer)

    def look_again(self) -> None:
        """Have routes recomputed, e.g. after a type became known. Any thread."""
        self._changed = True
        self._wake()

    def _wake(self, at: float = -NEVER, /) -> None:
        """Have `run_once` tick the services now, or at `at` if that is later. Any thread."""
        if at == -NEVER:
            self._look_now = True
        if at < self._sleeps_until:
            self._sleeps_until = at  # so that it is woken only once
            self._sooner.wake()

    # -- the proxy's own thread -----------------------------------------------------------

    def run_once(self, timeout_s: float = _IDLE_TICK_S) -> bool:
        """Wait briefly for a change, then route, advertise and tick; return whether one occurred.

        Raises RosError: The node's thread has ended: no request would be taken any more.
        """
        if self.node is not None and not self.node.alive:
            raise RosError("ROS has stopped; see the log for the reason", "start the proxy again")
        self._await_look(timeout_s)
        changed, self._changed = self._changed, False
        with self._lock:
            if changed:
                self._route()
            for link in self.links:
                link.flush()
            self._topics.tick()
            for service in self._services.values():
                service.dispatcher.tick()
            now = self.clock()
            if self.node is not None and (changed or now >= self._advertise_at):
                self._advertise_at = now + _IDLE_TICK_S
                for service in self._services.values():
                    service.advertise(self.node, now)
        return changed

    def _await_look(self, timeout_s: float) -> None:
        """Wait until a service is due, for at most `timeout_s`; later events wake the next call.

        While requests keep coming, wake when the next could be due, so that none must wake us.
        """
        now = self.clock()
        until = now + (min(timeout_s, _TICK_S) if len(self._topics) else timeout_s)
        while not self._look_now:
            self._sleeps_until = NEVER  # before checking: any event after this wakes us
            look_at = sleeps_until = until
            for service in list(self._services.values()):
                due_at, next_due_at = service.dispatcher.wants_tick(now)
                look_at, sleeps_until = min(look_at, due_at), min(sleeps_until, next_due_at)
            if look_at <= now or self._look_now:
                break
            self._sleeps_until = sleeps_until
            self._sooner.wait(max(0.0, self._sleeps_until - now))
            now = self.clock()
        self._look_now = False

    def _route(self) -> None:
        links = list(self.links)
        types = self._types()
        differ = {key_of(link): self._type_check.differences(link, types) for link in links}
        self._topics.route({key_of(link): link for link in links}, differ)
        versions = {id: member.version for id, member in self.links.members.items()}
        draining = frozenset(link.peer.id for link in links if self.links.draining(link))
        hanging = self.links.hanging()
        for service in self._services.values():
            name = service.spec.name
            fit = [link for link in links if name not in differ[key_of(link)]]
            hang = {id for id, names in hanging.items() if name in names}
            service.dispatcher.route(service.may_ask(fit, draining), versions, draining, hang)

    # -- reports --------------------------------------------------------------------------

    def report(self) -> dict[str, Any]:
        """Return the report of links and services for `proxy-status.json`."""
        with self._lock:
            links, gateways = self._link_reports()
            services: Mapping[str, Any] = {
                name: {
                    **service.dispatcher.report(),
                    "type": service.spec.type,
                    "trouble": service.trouble,
                }
                for name, service in self._services.items()
            }
            topics = self._topics.report()
        return {
            "links": links,
            "gateways": gateways,
            "services": services,
            "topics": topics,
            "uplink_suspected": self.links.silent_together,
            "certificate": self.dialer.certificate(),
        }

    def _link_reports(self) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Return reports of replicas, including those behind gateways, and of gateways."""
        dispatchers = [service.dispatcher for service in self._services.values()]
        types = self._types()
        replicas, gateways, behind = [], [], []
        for link in sorted(self.links, key=lambda link: link.peer.id):
            member = self.links.members[link.peer.id]
            report = link_report(
                *(link, dispatchers, self._type_check.differences(link, types)),
                draining=self.links.draining(link),
                misread=self._topics.misreads(key_of(link)),
            )
            if not member.gateway:
                replicas.append(report)
                continue
            gateways.append({"name": member.gateway, "endpoint": member.endpoint, **report})
            behind += seen_through(link.status(), member.gateway)
        return [*replicas, *best_of(behind)], gateways

    def behind(self) -> tuple[GatewayView, ...]:
        """Return the state of each replica, as a gateway reports it to its robots."""
        with self._lock:
            links, _ = self._link_reports()
        return tuple(GatewayView.of(report) for report in links)

    @property
    def offered(self) -> list[str]:
        """The names of the services currently offered in ROS."""
        return [name for name, service in self._services.items() if service.server is not None]

    def begin_hand_over(self) -> None:
        """Begin a hand-over: leave topics to the other proxy, record requests taken from now on."""
        with self._lock:
            for service in self._services.values():
                service.dispatcher.taken = []
            self._topics.close()

    def take_no_more(self) -> None:
        """Stop taking requests: another proxy takes them."""
        with self._lock:
            for service in self._services.values():
                service.dispatcher.takes_no_more = True

    def waiting(self, *, ordered: bool = False) -> int:
        """Count the unanswered requests, of all or only of stateful services."""
        with self._lock:
            services = [s for s in self._services.values() if s.spec.state or not ordered]
            return sum(service.dispatcher.waiting for service in services)

    def hold(self) -> dict[str, list[bytes]]:
        """Stop ordering stateful services; return the requests taken since the hand-over began."""
        with self._lock:
            services = [s for s in self._services.values() if s.spec.state]
            return {s.spec.name: s.dispatcher.hold() for s in services}

    def take_over(self, taken: Mapping[str, Collection[bytes]] | None) -> None:
        """Order stateful services, except requests the other proxy has taken (None: unknown)."""
        with self._lock:
            for name, service in self._services.items():
                service.dispatcher.take_over(None if taken is None else taken.get(name, ()))
        self.look_again()

    def trace(self) -> list[dict[str, Any]]:
        """Return the request outcomes of traced services since the last call."""
        past_s = time.time() - time.monotonic()
        with self._lock:
            return [
                {**line, "at": round(line["at"] + past_s, 6), "service": name}
                for name, service in self._services.items()
                for line in service.dispatcher.trace()
            ]

    def close(self) -> None:
        """Close every link. The owner closes the ROS node."""
        with self._lock:
            for link in self.links:
                self._drop(link.peer.id)
            self._topics.close()


def _kind(spec: ServiceSpec) -> object:
    """Return what must stay equal for a dispatcher to switch policies without losing requests."""
    return spec.type, spec.state, spec.quorum, spec.tolerance
