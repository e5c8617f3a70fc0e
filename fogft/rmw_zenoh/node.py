"""A ROS node that speaks `rmw_zenoh` without a ROS installation (`fogft.ros.port.RosNode`).

Its session is configured like those of other nodes: a peer that finds others through its machine's
router. ``ZENOH_SESSION_CONFIG_URI`` (a file) replaces all settings, ``ZENOH_CONFIG_OVERRIDE``
(``key=value;key=value``) some of them. Design: docs/design/serialised-services.md.
"""

import functools
import itertools
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import zenoh
from zenoh import handlers

from fogft.errors import RosError
from fogft.link.zenoh import settings
from fogft.model.cdr import Shape
from fogft.model.type_definition import REQUEST, RESPONSE
from fogft.rmw_zenoh import naming
from fogft.rmw_zenoh.entities import Client, Server
from fogft.rmw_zenoh.naming import CLIENT, NODE, SERVER, Graph, Token
from fogft.ros import vendors
from fogft.ros.pacing.pacer import NodeProbes
from fogft.ros.reservations import own_domain

_LOOK_EVERY_S = 1.0

FaultOf = Callable[[str, str], Callable[[bytes], str]]


class RmwZenohNode:
    """Serialised services and clients among the `rmw_zenoh` nodes of one ROS domain.

    `domain_id` defaults to ``ROS_DOMAIN_ID``, else 0. `hashes_of` returns the hashes of a service
    type that others report, once for each report: the most reported one is used, on a tie one that
    a client has. `fault_of` returns a function that says why bytes are not a request, or response,
    of a type; such bytes are not passed on. Zenoh's thread calls `noticed`, which must not block,
    when a client appears. Raises RosError: the environment variables are unusable.
    """

    def __init__(
        self,
        name: str,
        domain_id: int | None = None,
        *,
        hashes_of: Callable[[str], Sequence[str]] = lambda _: (),
        fault_of: FaultOf = lambda type_name, part: Shape("", {}).fault,
        noticed: Callable[[], None] = lambda: None,
        environ: Mapping[str, str] = os.environ,
    ) -> None:
        self._name = name
        self._hashes_of = hashes_of
        self._look_at = 0.0
        self._fault_of = fault_of
        self._noticed = noticed
        self._domain = own_domain(environ) if domain_id is None else domain_id
        self._numbers = itertools.count(1)
        self._made: list[Server | Client] = []
        self._lock = threading.Lock()
        self._open = True
        config = settings_from(environ)
        try:
            self._session: Any = zenoh.open(config)
            self._id = str(self._session.zid())
            self.graph = Graph(self._id)
            self.offered = self.graph.offered
            self._probes = NodeProbes(self.client, self.graph.same_node_serves)
            live = self._session.liveliness()
            node = Token(self._domain, self._id, "0", "0", NODE, self._name)
            self._declared = live.declare_token(str(node))
            seen = handlers.Callback(self._seen, indirect=False)
            tokens = f"{naming.ROOT}/{self._domain}/**"
            self._subscriber = live.declare_subscriber(tokens, seen, history=True)
        except zenoh.ZError as error:
            raise RosError(f"no Zenoh session among `rmw_zenoh`'s nodes: {error}") from error

    def _seen(self, sample: Any) -> None:
        key = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.DELETE:
            self.graph.drop(key)
            return
        token = self.graph.put(key)
        if token is None or token.kind != CLIENT:
            return
        for made in list(self._made):
            if isinstance(made, Server) and (made.name, made.type) == (token.service, token.type):
                made.clients_hash(token.hash)
        self._noticed()

    @property
    def alive(self) -> bool:
        """Whether the node is open."""
        return self._open and not self._session.is_closed()

    def serve(
        self,
        name: str,
        type_name: str,
        on_request: Callable[[bytes, Any], None],
        on_burst: Callable[[bool], None] | None = None,
    ) -> Server:
        """Offer a service. The first request may arrive before this returns.

        Raises RosError: The type's hash is not known yet, or the node is closed.
        """
        known = self._hash(name, type_name)
        if not known:
            raise RosError(
                f"the type hash of `{type_name}` is not known here yet",
                "a ready replica or a client on the robot provides it",
            )
        server: Server = self._add(
            lambda: Server(
                *(self._session, self._tokens(SERVER, name, type_name), known, on_request),
                self._fault_of(type_name, RESPONSE),
                probes=self._probes,
                mismatch=lambda: vendors.of_others(name, self.graph.servers(name)),
            )
        )
        self._tell_clients(server)
        return server

    def _hash(self, name: str, type_name: str) -> str:
        """Return the hash to offer a service under; empty if none has been reported."""
        clients = self.graph.hashes(CLIENT, name, type_name)
        told = self._hashes_of(type_name) or clients
        return max(told, key=lambda one: (told.count(one), one in clients), default="")

    def _tell_clients(self, server: Server) -> None:
        for hash in self.graph.hashes(CLIENT, server.name, server.type):
            server.clients_hash(hash)

    def client(self, name: str, type_name: str) -> Client:
        """Create a client of a service. Raises RosError: the node is closed."""
        servers = functools.partial(self.graph.hashes, SERVER, name, type_name)
        fault = self._fault_of(type_name, REQUEST)
        made: Client = self._add(
            lambda: Client(self._session, self._tokens(CLIENT, name, type_name), servers, fault)
        )
        return made

    def look(self) -> None:
        """Offer services under the hash that most now report: the first report may be wrong."""
        now = time.monotonic()
        if now < self._look_at:
            return
        self._look_at = now + _LOOK_EVERY_S
        for made in list(self._made):
            if isinstance(made, Server) and made.is_open:
                hash = self._hash(made.name, made.type)
                if hash and made.move(hash):
                    self._tell_clients(made)

    def _tokens(self, kind: str, name: str, type_name: str) -> Callable[[str], Token]:
        id = str(next(self._numbers))
        fields = (self._domain, self._id, "0", id, kind, self._name, "/", name, type_name)
        return lambda hash: Token(*fields, hash)

    def _add(self, make: Callable[[], Server | Client]) -> Any:
        with self._lock:
            if not self._open:
                raise RosError("the ROS node is closed")
            try:
                made = make()
            except zenoh.ZError as error:
                raise RosError(f"Zenoh refuses a service or client: {error}") from error
            self._made = [*(m for m in self._made if m.is_open), made]
            return made

    def close(self) -> None:
        """Close all services and clients, and the session. Idempotent."""
        with self._lock:
            if not self._open:
                return
            self._open = False
        for made in self._made:
            made.close()
        self._session.close()


FILE, OVERRIDE = "ZENOH_SESSION_CONFIG_URI", "ZENOH_CONFIG_OVERRIDE"
ROUTER = "tcp/localhost:7447"

SETTINGS: dict[str, Any] = {
    "mode": "peer",
    "connect/endpoints": [ROUTER],
    "connect/timeout_ms": -1,  # keep trying: the router may start later
    "connect/exit_on_failure": False,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
    "listen/endpoints": ["tcp/localhost:0"],
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": True,
    "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
    "scouting/gossip/autoconnect": {"router": [], "peer": ["router", "peer"]},
    "scouting/gossip/autoconnect_strategy": {
        "peer": {"to_router": "always", "to_peer": "greater-zid"}
    },
    "queries_default_timeout": 600_000,
    "transport/shared_memory/enabled": False,
    "transport/link/rx/max_message_size": 1 << 30,
}


def settings_from(environ: Mapping[str, str]) -> zenoh.Config:
    """Return an environment's Zenoh configuration. Raises RosError: a variable is unusable."""
    path = environ.get(FILE)
    try:
        made = zenoh.Config.from_file(path) if path else settings.to_zenoh(SETTINGS)
    except Exception as error:
        raise RosError(f"`{FILE}={path}` cannot be used: {error}") from error
    settings.to_zenoh({})  # sets up Zenoh's threads, whoever configures the session
    for pair in filter(str.strip, environ.get(OVERRIDE, "").split(";")):
        key, _, value = map(str.strip, pair.partition("="))
        try:
            made.insert_json5(key, value)
        except Exception as error:
            raise RosError(
                f"`{OVERRIDE}` cannot be used at `{key}`: {error}",
                'write `key=value;key=value`, such as `connect/endpoints=["tcp/10.0.0.5:7447"]`',
            ) from error
    return made
