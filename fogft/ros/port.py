"""The port to ROS 2: serialised services and clients, for any type, never a Python message.

One context, one node and one thread that takes (one wait set) for each `RosNode`.
Callbacks come from that thread and must not block. Responses and requests may be sent
from any thread.

Implementations: `fogft.ros.node.SerialisedNode` (rclpy), `fogft.rmw_zenoh.node.RmwZenohNode`
(Zenoh, no ROS installed), `tests.fakes.ros` (tests). Topics pass by the first alone.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Protocol

from fogft.errors import RosError

OnBurst = Callable[[bool], None]  # gets True where a burst begins, False where it has ended


class NotFoundYet(RosError):
    """The client is not discovered yet; sending again may help."""


class RosServer(Protocol):
    """A service that this node offers."""

    def respond(self, handle: Any, payload: bytes) -> None:
        """Send the serialised response to the request that came with `handle`.

        Any thread. A client that is gone is no error. At most once for each handle.
        """

    def mismatch(self) -> str:
        """Return why clients are not received, or who else answers; empty if all is well. Cheap."""

    def close(self) -> None:
        """Withdraw the service."""


class RosClient(Protocol):
    """A client of a local service."""

    def available(self) -> bool:
        """Whether discovery has found a server. Cheap; never blocks."""

    def is_known(self) -> bool:
        """Whether the server has discovered this client too; until then its responses are lost.

        True where that cannot be known. One thread calls it, at about 10 Hz.
        """

    def mismatch(self) -> str:
        """Return why none of the servers can be called; empty if one can. Cheap."""

    def servers(self) -> int:
        """Count the servers that discovery lists: one that died stays listed for a while."""

    def call(self, payload: bytes, on_response: Callable[[bytes], None]) -> int:
        """Send a serialised request; `on_response` comes at most once. Returns a ticket.

        Raises:
            Unreadable: The bytes are no request of this type.
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
        """Whether its thread runs. It ends by `close`, or by an error, which was logged."""

    def serve(
        self,
        name: str,
        type_name: str,
        on_request: Callable[[bytes, Any], None],
        on_burst: OnBurst | None = None,
    ) -> RosServer:
        """Offer a service.

        Args:
            on_request: Gets the serialised request and a handle.
            on_burst: Told, by the same thread, before and after requests that came together.

        Raises:
            RosError: The type cannot be loaded.
        """

    def client(self, name: str, type_name: str) -> RosClient:
        """Create a client of a service. Raises RosError: the type cannot be loaded."""

    def look(self) -> None:
        """Keep this process known to others. Call it every second or more often."""

    def offered(self) -> Mapping[str, str]:
        """Return name -> type of the services that applications offer in this domain.

        As discovery knows them now, without those of ROS itself and of proxies.
        """

    def close(self) -> None:
        """Stop the thread and close the node. Repeatable."""


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
