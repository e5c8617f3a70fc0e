"""The interface to ROS 2: serialised services and clients of any type, without Python messages.

Each `RosNode` has one context, one node and one take loop (a thread with one wait set).
Callbacks run on that thread and must not block. Responses and requests may be sent from
any thread.

Implementations: `fogft.ros.node.SerialisedNode` (rclpy), `fogft.rmw_zenoh.node.RmwZenohNode`
(Zenoh, no ROS installed), `tests.fakes.ros` (tests). Only the first supports topics.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Protocol

from fogft.errors import RosError

OnBurst = Callable[[bool], None]  # called with True when a burst begins, False after it


class NotFoundYet(RosError):
    """The client is not discovered yet; sending again may help."""


class RosServer(Protocol):
    """A service that this node offers."""

    def respond(self, handle: Any, payload: bytes) -> None:
        """Send the serialised response to the request that came with `handle`.

        Any thread. No error if the client is gone. Call it at most once for each handle.
        """

    def mismatch(self) -> str:
        """Return why a client gets no answers, or who else serves; empty if neither. Cheap."""

    def close(self) -> None:
        """Withdraw the service."""


class RosClient(Protocol):
    """A client of a local service."""

    def available(self) -> bool:
        """Whether discovery has found a server. Cheap; never blocks."""

    def is_known(self) -> bool:
        """Whether the server has discovered this client too; until then its responses are lost.

        True if that cannot be determined. One thread calls it, at about 10 Hz.
        """

    def mismatch(self) -> str:
        """Return why none of the servers can be called; empty if one can. Cheap."""

    def servers(self) -> int:
        """Count the servers that discovery lists; one that died stays listed for a while."""

    def call(self, payload: bytes, on_response: Callable[[bytes], None]) -> int:
        """Send a serialised request; `on_response` is called at most once. Returns a ticket.

        Raises:
            Unreadable: The bytes are not a request of this type.
            RosError: ROS refused the request (its queue is full, the client is closed).
        """

    def forget(self, ticket: int) -> None:
        """Drop a request whose response is no longer awaited."""

    def close(self) -> None:
        """Withdraw the client."""


class RosNode(Protocol):
    """The proxy's ROS node in one ROS domain."""

    @property
    def alive(self) -> bool:
        """Whether the node's thread runs. `close` ends it, or an error, which is logged."""

    def serve(
        self,
        name: str,
        type_name: str,
        on_request: Callable[[bytes, Any], None],
        on_burst: OnBurst | None = None,
    ) -> RosServer:
        """Offer a service.

        Args:
            on_request: Called with the serialised request and a handle.
            on_burst: Called by the same thread before and after requests that came together.

        Raises RosError: The type cannot be loaded.
        """

    def client(self, name: str, type_name: str) -> RosClient:
        """Create a client of a service. Raises RosError: the type cannot be loaded."""

    def look(self) -> None:
        """Keep this process discoverable. Call it at least once a second."""

    def offered(self) -> Mapping[str, str]:
        """Return name -> type of the services that applications offer in this domain.

        As currently discovered, without those of ROS itself and of proxies.
        """

    def close(self) -> None:
        """Stop the thread and close the node. Idempotent."""


class Level(IntEnum):
    """The level of a status; the numbers of `diagnostic_msgs/msg/DiagnosticStatus`."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True)
class Status:
    """One status of `/diagnostics`; `hardware_id` names the robot or the replica."""

    level: Level
    name: str
    message: str
    hardware_id: str
    values: Mapping[str, str] = field(default_factory=dict)
