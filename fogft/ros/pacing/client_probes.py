"""Probes of clients' nodes, to learn whether their executors take responses.

A ROS node answers the services of its parameters by the same executor that takes its clients'
responses, one in each turn: an answer means that there was a turn.

Owns: whose node a client is, and the probes on the way. Not here: what they show (`pace`).
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable

from fogft.errors import RosError
from fogft.ros.port import RosClient

_SERVICE, _TYPE = "get_parameter_types", "rcl_interfaces/srv/GetParameterTypes"
_OF_NO_PARAMETER = b"\x00\x01\x00\x00" + bytes(4)  # a list of names, which is empty
KEPT = 64


class NodeProbes:
    """Probes of the nodes in one ROS domain, for the clients of all services. Any thread.

    Args:
        make_client: As `RosNode.client`.
        same_node_serves: Returns the full name of the service of a last name, of the node that a
            client of a service belongs to: None while it is not discovered, empty without one.
    """

    def __init__(
        self,
        make_client: Callable[[str, str], RosClient],
        same_node_serves: Callable[[str, str, bytes], str | None],
    ) -> None:
        self._make_client, self._same_node_serves = make_client, same_node_serves
        self._by_name: dict[str, RosClient] = {}
        self._by_client: dict[bytes, RosClient] = {}
        self._lock = threading.Lock()

    def answers(self, service: str, client: bytes) -> bool | None:
        """Whether the node of a service's client answers probes; None while it is not known."""
        asked = self._same_node_serves(_SERVICE, service, client)
        if not asked:
            return None if asked is None else False
        with self._lock:
            end = self._by_name.get(asked)
            if end is None:
                if len(self._by_name) >= KEPT:
                    self._by_name.pop(next(iter(self._by_name))).close()
                try:
                    end = self._by_name[asked] = self._make_client(asked, _TYPE)
                except RosError:
                    return False
            if not end.available():
                return None
            if len(self._by_client) >= 4 * KEPT:  # long gone
                self._by_client.pop(next(iter(self._by_client)))
            self._by_client[client] = end
        return True

    def same_node(self, client: bytes, other: bytes) -> bool:
        """Whether two clients' nodes have one name: one was started again as the other."""
        return self._by_client.get(client) is self._by_client.get(other)

    def send(self, client: bytes, on_answer: Callable[[], None]) -> None:
        """Try to send a probe; `on_answer` is called from the take loop, or never."""
        with contextlib.suppress(KeyError, RosError):
            self._by_client[client].call(_OF_NO_PARAMETER, lambda _: on_answer())
