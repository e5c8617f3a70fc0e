"""The proxy's ROS node: one context, one thread, one wait set for all services and clients.

Two rules:
1. Only the take loop touches the wait set and destroys entities. Other threads put their
   changes into a list and trigger the guard condition.
2. Callbacks run on the take loop. They must not block; their exceptions are logged.

Owns: the context, the node, the thread, quality of service.
Not here: pending requests (`entities`), bytes (`serialised`).
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any, TypeVar

from fogft.errors import RosError
from fogft.model import ros_names
from fogft.model.topic import TopicSpec
from fogft.ros import cyclone, spdp, topic_ends, vendors
from fogft.ros.entities import Client, ReadinessProbe, Server
from fogft.ros.joining import EarlyJoin, Timers, bare_node, new_context
from fogft.ros.pacing.pacer import PROBED, PROBED_TYPE, NodeProbes
from fogft.ros.port import OnBurst
from fogft.ros.serialised import ClientEnd, ServiceEnd, self_test
from fogft.ros.shared_memory import PortWatch
from fogft.ros.topic_ends import Publisher, Subscription
from fogft.ros.types import load_message_type, load_service_type, shape
from fogft.ros.visible import VisibleNode

log = logging.getLogger(__name__)

Entity = Server | Client | Publisher | Subscription
E = TypeVar("E", Server, Client, Publisher, Subscription)

_CLOSE_LIMIT_S = 10.0  # ending takes milliseconds; more means that a callback blocks
_KEPT = 5000  # Fast DDS keeps no more of any kind
_KNOWN_AFTER_S = 2.0  # until running nodes know a new node, even if they are many or busy
_NO_LIMIT = -1  # rcl_wait waits until something happens
_REST = 9  # times a wait set's build time before the next: many entities may be created in a row


class SerialisedNode:
    """Serialised services and clients in one ROS domain (`fogft.ros.port.RosNode`).

    Args:
        domain_id: The ROS domain; None for ``ROS_DOMAIN_ID``, else 0.
        early: This process's participant in that domain, if it has joined already.

    Raises RosError: ROS 2 is not usable here, or refuses the name.
    """

    def __init__(
        self, name: str, domain_id: int | None = None, *, early: EarlyJoin | None = None
    ) -> None:
        self._entities: tuple[Entity, ...] = ()
        self._changes: list[tuple[Entity, bool, threading.Event]] = []
        self._create_lock = threading.Lock()  # rcl wants one creation at a time
        self._stopping = False
        self._ended = threading.Event()
        self._visible: VisibleNode | None = None
        self._probes = NodeProbes(self.client, self.same_node_serves, self._found)
        self._timers = Timers()
        try:
            self._start_ros(name, domain_id, early)
        except ImportError as error:
            raise RosError(
                f"ROS 2 cannot be used here: {error}",
                "source a ROS 2 installation, or install `fogft[ros]`",
            ) from error
        except Exception as error:
            raise RosError(f"the ROS node `{name}` cannot be created: {error}") from error
        self._thread = threading.Thread(target=self._run, name=f"ros-{name}", daemon=True)
        self._thread.start()

    def _start_ros(self, name: str, domain_id: int | None, early: EarlyJoin | None) -> None:
        from rclpy.guard_condition import GuardCondition
        from rclpy.impl.implementation_singleton import rclpy_implementation
        from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
        from rclpy.utilities import get_rmw_implementation_identifier

        self_test()
        self._middleware: str = get_rmw_implementation_identifier()
        by_cyclone = self._middleware == cyclone.MIDDLEWARE
        self.identity: Callable[[bytes], bytes] = cyclone.identity if by_cyclone else bytes
        self._new_wait_set: Any = rclpy_implementation.WaitSet
        quality = partial(
            QoSProfile,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.VOLATILE,
        )
        self._quality = quality(history=HistoryPolicy.KEEP_ALL)
        # Responses that killed clients have not received are kept until their leases end. With
        # KEEP_ALL, once there are this many, responses to other clients are refused.
        self._served = quality(history=HistoryPolicy.KEEP_LAST, depth=_KEPT)
        self._context: Any = early.context if early is not None else new_context(domain_id)
        try:
            self._node = bare_node(name, self._context)
            self._guard = GuardCondition(None, None, context=self._context)
        except BaseException:
            self._context.try_shutdown()
            raise
        domain_id = self._context.get_domain_id()
        self._ports = PortWatch(domain_id)
        self._early, self._known_at = early, time.monotonic() + _KNOWN_AFTER_S
        self._introduction = early.introduction if early else spdp.Introduction(domain_id)

    @property
    def alive(self) -> bool:
        """Whether the take loop runs. `close` ends it, or an error, which is logged."""
        return not self._ended.is_set()

    def serve(
        self,
        name: str,
        type_name: str,
        on_request: Callable[[bytes, Any], None],
        on_burst: OnBurst | None = None,
    ) -> Server:
        """Offer a service. The first request may arrive before this returns."""
        service_type = load_service_type(type_name)

        def create() -> Server:
            service: Any = self._node.create_service(
                service_type, name, lambda _, response: response, qos_profile=self._served
            )
            return Server(
                *(service, ServiceEnd(service, service_type), on_request, self._withdraw),
                on_burst=on_burst or (lambda begins: None),
                probes=self._probes,
                mismatch=partial(self._server_trouble, service.service_name),
            )

        return self._add(name, create)

    def client(self, name: str, type_name: str) -> Client:
        """Create a client of a service."""
        service_type = load_service_type(type_name)

        def create() -> Client:
            client: Any = self._node.create_client(service_type, name, qos_profile=self._quality)
            find = partial(self._beside_server, PROBED, client.srv_name)
            return Client(
                *(client, ClientEnd(client, service_type), self._withdraw, self._count_servers),
                mismatch=partial(self._servers_mismatch, name),
                probe=ReadinessProbe(find, lambda asked: self.client(asked, PROBED_TYPE)),
            )

        return self._add(name, create)

    def _count_servers(self, service: str) -> int:
        """Count the servers of an absolute service name: rclpy's own method takes twice as long."""
        handle = self._node.handle
        # ROS 2 Humble cannot count servers: there `available` has to suffice.
        count: Any = getattr(handle, "get_count_services", lambda _: 0)
        with handle:
            return int(count(service))

    def publisher(self, topic: TopicSpec) -> Publisher:
        """Create a publisher of a topic. Raises RosError: the type cannot be loaded."""
        message_type = load_message_type(topic.type)

        def create() -> Publisher:
            profile = topic_ends.profile(topic)
            made: Any = self._node.create_publisher(message_type, topic.name, profile)
            found = partial(self._node.get_subscriptions_info_by_topic, made.topic_name)
            mismatch = partial(topic_ends.mismatch, "subscriber", topic, found)
            return Publisher(made, shape(message_type), self._withdraw, mismatch)

        return self._add(topic.name, create)

    def subscribe(self, topic: TopicSpec, on_message: Callable[[bytes], None]) -> Subscription:
        """Subscribe to a topic's serialised messages. RosError: the type cannot be loaded."""
        message_type = load_message_type(topic.type)

        def create() -> Subscription:
            made: Any = self._node.create_subscription(
                message_type, topic.name, lambda _: None, topic_ends.profile(topic), raw=True
            )
            found = partial(self._node.get_publishers_info_by_topic, made.topic_name)
            mismatch = partial(topic_ends.mismatch, "publisher", topic, found)
            return Subscription(made, on_message, self._withdraw, mismatch)

        return self._add(topic.name, create)

    def make_visible(self, name: str, judge: Callable[[Mapping[str, Any]], str]) -> VisibleNode:
        """Create a second node, visible to ROS tools (see `VisibleNode`). It ends with this one.

        Raises RosError: ROS refuses it, or this node is closed.
        """
        with self._create_lock:
            if self._stopping or self._ended.is_set():
                raise RosError("the ROS node is closed")
            self._visible = VisibleNode(name, self._context, judge)
        return self._visible

    def offered(self) -> dict[str, str]:
        """Return name -> type of the discovered services that applications offer.

        Queried node by node, because the list of all names also contains those of clients.
        """
        found: dict[str, str] = {}
        with contextlib.suppress(Exception):  # rclpy's InvalidHandle: closed meanwhile
            for name, namespace in self._node.get_node_names_and_namespaces():
                if not ros_names.is_application(name):
                    continue
                with contextlib.suppress(Exception):  # the node has gone since
                    services = self._node.get_service_names_and_types_by_node(name, namespace)
                    for service, kinds in services:
                        if kinds and ros_names.is_of_application(service, kinds[0]):
                            found.setdefault(service, kinds[0])
        return found

    def same_node_serves(self, what: str, service: str, client: bytes) -> str | None:
        """Return the full name of the service `what` of the node that a client belongs to.

        None while it is not discovered, empty if there is none: a process's endpoints are
        discovered in order of creation, a node's own services before its clients. The node's name
        may arrive three seconds later; until then its process's only such service is taken.

        `client` is the first 16 bytes of a request's handle: the GID of the reader of its
        responses or, under CycloneDDS, an id for the writer of its requests.
        """
        end = self._found(service, [client]).get(client)
        return None if end is None else self._same_node(what, end)

    def _found(self, service: str, clients: Collection[bytes]) -> dict[bytes, Any]:
        """Return what discovery tells of those clients of a service that it lists."""
        ends = dict(zip(clients, clients, strict=True))
        if self._middleware == cyclone.MIDDLEWARE:
            domain_id = self._context.get_domain_id()
            ends = {client: cyclone.writer_of(client, domain_id) for client in clients}
            find, topic = self._node.get_publishers_info_by_topic, f"rq{service}Request"
        else:
            find, topic = self._node.get_subscriptions_info_by_topic, f"rr{service}Reply"
        listed = {bytes(end.endpoint_gid)[:16]: end for end in self._endpoints(find, topic)}
        return {client: listed[end] for client, end in ends.items() if end in listed}

    def _beside_server(self, what: str, service: str) -> str | None:
        """Like `same_node_serves`, for the last node that discovery lists as a server."""
        readers = self._endpoints(self._node.get_subscriptions_info_by_topic, f"rq{service}Request")
        return self._same_node(what, readers[-1]) if readers else None

    def _same_node(self, what: str, end: Any) -> str | None:
        process = bytes(end.endpoint_gid)[: spdp.PREFIX_BYTES]
        if end.node_name.startswith("_"):  # its name is not known yet
            topics = self._request_topics(what)
        else:
            topics = [f"rq{end.node_namespace.rstrip('/')}/{end.node_name}/{what}Request"]
        found = [topic for topic in topics if self._reads(process, topic)]
        if len(found) > 1:
            return None
        return found[0][len("rq") : -len("Request")] if found else ""

    def _request_topics(self, what: str) -> list[str]:
        """Return the request topics of all nodes' services with this last name."""
        with contextlib.suppress(Exception):  # rclpy's InvalidHandle
            known = self._node.get_topic_names_and_types(no_demangle=True)
            return [topic for topic, _ in known if topic.endswith(f"/{what}Request")]
        return []

    def _reads(self, process: bytes, topic: str) -> bool:
        readers = self._endpoints(self._node.get_subscriptions_info_by_topic, topic)
        return any(bytes(one.endpoint_gid).startswith(process) for one in readers)

    def participant(self, service: str) -> bytes:
        """Return the prefix of our DDS participant's id; empty before `service` is offered.

        Also empty while another node of our name offers it: one that hands over or was killed.
        """
        requests, own = f"rq{service}Request", self._node.get_name()
        named = {
            bytes(reader.endpoint_gid)[: spdp.PREFIX_BYTES]
            for reader in self._endpoints(self._node.get_subscriptions_info_by_topic, requests)
            if reader.node_name == own
        }
        return named.pop() if len(named) == 1 else b""

    def callers(self, service: str) -> int:
        """Count the discovered clients of a service, which have found us as well."""
        return len(self._identifiers(self._node.get_publishers_info_by_topic, service))

    def _server_trouble(self, service: str) -> str:
        writers = self._identifiers(self._node.get_publishers_info_by_topic, service)
        others = vendors.strangers(self._middleware, writers)
        if others:
            return vendors.of_client(service, self._middleware, others[0])
        readers = self._endpoints(self._node.get_subscriptions_info_by_topic, f"rq{service}Request")
        own = self._node.get_name()
        return vendors.of_others(
            service,
            (
                f"{one.node_namespace.rstrip('/')}/{one.node_name}"
                for one in readers
                if one.node_name != own
                and not one.node_name.startswith("_")  # its name is not known yet
                and not vendors.strangers(self._middleware, [bytes(one.endpoint_gid)])
            ),
        )

    def _servers_mismatch(self, service: str) -> str:
        readers = self._identifiers(self._node.get_subscriptions_info_by_topic, service)
        others = vendors.strangers(self._middleware, readers)
        none_is_ours = others and len(others) == len(readers)
        return vendors.of_server(service, self._middleware, others[0]) if none_is_ours else ""

    def _identifiers(self, find: Any, service: str) -> list[bytes]:
        """Return the GIDs of the writers, or readers, of requests to a service."""
        return [bytes(one.endpoint_gid) for one in self._endpoints(find, f"rq{service}Request")]

    @staticmethod
    def _endpoints(find: Any, topic: str) -> list[Any]:
        """Return the discovered writers, or readers, of a topic; none once closed."""
        with contextlib.suppress(Exception):  # rclpy's InvalidHandle
            return list(find(topic, no_mangle=True))
        return []

    def look(self) -> None:
        """Keep this process discoverable. Call it at least once a second."""
        with self._create_lock:
            if not self._stopping and not self._ended.is_set():
                self._timers.look(self._node)
                if self._early is not None and time.monotonic() > self._known_at:
                    self._early.end_node()
                    self._early = None

    def _add(self, name: str, create: Callable[[], E]) -> E:
        """Create an entity and hand it to the take loop."""
        with self._create_lock:
            if self._stopping or self._ended.is_set():
                raise RosError("the ROS node is closed")
            try:
                entity = create()
            except RosError:
                raise
            except Exception as error:
                raise RosError(f"`{name}` cannot be created: {error}") from error
            self._changes.append((entity, True, threading.Event()))
            if len(self._changes) == 1:
                self._guard.trigger()
        return entity

    def _withdraw(self, entity: Entity) -> None:
        done = threading.Event()
        with self._create_lock:
            if self._ended.is_set():
                return  # the loop destroyed everything at its end
            self._changes.append((entity, False, done))
            self._guard.trigger()
        if threading.current_thread() is not self._thread:
            done.wait(_CLOSE_LIMIT_S)

    def close(self) -> None:
        """Stop the thread and close the node. Idempotent; from a callback it only requests that."""
        if self._visible is not None:
            self._visible.close()
        with self._create_lock:
            self._stopping = True
            if not self._ended.is_set():
                self._guard.trigger()
        if threading.current_thread() is not self._thread:
            self._thread.join(_CLOSE_LIMIT_S)
            if self._thread.is_alive():
                log.warning("the take loop of ROS does not end: a callback blocks")

    def _run(self) -> None:
        try:
            wait_set, waiting = self._apply_changes()
            rest_until = 0.0
            while not self._stopping:
                began = time.monotonic()
                if self._changes and (  # a caller waits for a withdrawal
                    began >= rest_until or not all(added for _, added, _ in tuple(self._changes))
                ):
                    wait_set, waiting = self._apply_changes()
                    now = time.monotonic()
                    rest_until = now + _REST * (now - began)
                wait_set.clear_entities()
                wait_set.add_guard_condition(self._guard.handle)
                for add, _, entity in waiting:
                    add(entity.handle)
                rest_s = rest_until - time.monotonic() if self._changes else None
                wait_set.wait(_NO_LIMIT if rest_s is None else max(0, int(rest_s * 1e9)))
                is_ready = wait_set.is_ready
                ready = [entity for (_, where, entity) in waiting if is_ready(*where)]
                for entity in ready:
                    entity.drain()
        except Exception:
            log.exception("the take loop of ROS ended")
        finally:
            self._end_ros()

    def _apply_changes(self) -> tuple[Any, list[tuple[Any, tuple[str, int], Any]]]:
        """Return a new wait set and, for each entity, how to add it and its index there."""
        with self._create_lock:
            changes, self._changes = self._changes, []
        entities = dict.fromkeys(self._entities)
        for entity, added, _ in changes:
            if added:
                entities[entity] = None
            else:
                entities.pop(entity, None)
        self._entities = tuple(entities)
        for entity, added, done in changes:
            if not added:
                entity.destroy(self._node)
            done.set()
        services = [entity for entity in self._entities if isinstance(entity, Server)]
        clients = [entity for entity in self._entities if isinstance(entity, Client)]
        heard = [entity for entity in self._entities if isinstance(entity, Subscription)]
        context = self._context.handle
        sizes = (len(heard), 1, 0, len(clients), len(services), 0)  # 1 guard condition, no timers
        with context:
            wait_set = self._new_wait_set(*sizes, context)
        waiting: list[tuple[Any, tuple[str, int], Any]] = [
            *((wait_set.add_service, ("service", i), entity) for i, entity in enumerate(services)),
            *((wait_set.add_client, ("client", i), entity) for i, entity in enumerate(clients)),
            *((wait_set.add_subscription, ("subscription", i), e) for i, e in enumerate(heard)),
        ]
        return wait_set, waiting

    def _end_ros(self) -> None:
        with self._create_lock:
            self._ended.set()
            changes, self._changes = self._changes, []
        for entity in {*self._entities, *(entity for entity, _, _ in changes)}:
            entity.destroy(self._node)
        self._entities = ()
        for _, _, done in changes:
            done.set()
        self._introduction.close()
        self._ports.close()
        self._guard.destroy()
        if self._early is not None:
            self._early.end_node()
        self._node.destroy_node()
        self._context.try_shutdown()
