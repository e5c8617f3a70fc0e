"""Whether a client takes: its node's executor is asked for a turn.

Nothing in DDS tells what a reader has taken. But a ROS node answers services of its own, those of
its parameters, and by the same executor that takes its clients' responses, one in each turn: an
answer means that there was a turn.

Owns: whose node a client is, and the probes on the way. Not here: what they show (`pace`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from fogft.errors import RosError
from fogft.ros.port import ClientNode, RosClient

_SERVICE, _TYPE = "get_parameter_types", "rcl_interfaces/srv/GetParameterTypes"
_OF_NO_PARAMETER = b"\x00\x01\x00\x00" + bytes(4)  # a list of names, which is empty
KEPT = 64


class Graph(Protocol):
    """What is asked of a ROS node."""

    def client(self, name: str, type_name: str) -> RosClient:
        """Make a client of a service."""

    def node_of(self, service: str, client: bytes) -> ClientNode | None:
        """Return the node that a client of a service belongs to."""

    def services_of(self, name: str, namespace: str) -> Sequence[str]:
        """Return the names of a node's services."""


class NodeProbes:
    """Probes of the nodes in one ROS domain, for all services. Any thread."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self._ends: dict[str, RosClient] = {}
        self._lock = threading.Lock()

    def end(self, service: str, client: bytes) -> RosClient | bool | None:
        """Return the way to a client's node; False for none, None while it is not known."""
        found = self.graph.node_of(service, client)
        if found is None:
            return None
        name, namespace, _ = found
        asked = f"{namespace.rstrip('/')}/{name}/{_SERVICE}"
        if asked not in self.graph.services_of(name, namespace):
            return False
        with self._lock:
            end = self._ends.get(asked)
            if end is None:
                if len(self._ends) >= KEPT:
                    self._ends.pop(next(iter(self._ends))).close()
                end = self._ends[asked] = self.graph.client(asked, _TYPE)
        return end if end.available() else None


class ServiceProbes:
    """Probes of one service's clients: how it learns that an executor has had a turn."""

    def __init__(self, service: str, nodes: NodeProbes) -> None:
        self._service = service
        self._nodes = nodes
        self._ends: dict[bytes, Any] = {}

    def answers(self, client: bytes) -> bool | None:
        """Whether the client's node answers probes; None while discovery does not tell."""
        try:
            end = self._nodes.end(self._service, client)
        except RosError:
            return False
        if isinstance(end, bool) or end is None:
            return end
        if len(self._ends) >= 4 * KEPT:  # long gone: a service remembers fewer clients
            self._ends.pop(next(iter(self._ends)))
        self._ends[client] = end
        return True

    def unique(self, client: bytes) -> bool:
        """Whether only the client's own node can have answered.

        A node that was killed and started again answers what its predecessor was asked, which
        discovery lists until its lease ends.
        """
        found = self._nodes.graph.node_of(self._service, client)
        return found is not None and found.unique

    def send(self, client: bytes, on_answer: Callable[[], None]) -> None:
        """Send a probe; `on_answer` comes from the take loop, or never. It may not be sent."""
        try:
            self._ends[client].call(_OF_NO_PARAMETER, lambda _: on_answer())
        except (KeyError, RosError):
            return
