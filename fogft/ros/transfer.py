"""How the bytes of a message get out of and into ROS: the seam below the node.

Two implementations: `serialised` (fast, over rcl) and `converted` (over rclpy's own
messages). `choose` picks, once a type.

Owns: the contract of the two and the choice.
Not here: the thread, the wait set and the pending requests (`node`).
"""

from __future__ import annotations

import logging
from typing import Any, Protocol

from fogft.errors import RosError

log = logging.getLogger(__name__)


class ServiceEnd(Protocol):
    """Bytes of one service. `take` belongs to the take loop; `respond` needs the caller's lock."""

    def take(self) -> tuple[bytes, Any] | None:
        """Return the next serialised request and its handle; None when there is none.

        Raises:
            RosError: It could not be read; it is gone.
        """

    def respond(self, handle: Any, payload: bytes) -> None:
        """Send a serialised response.

        Raises:
            RosError: The bytes are no such message, or ROS refused them.
        """

    def close(self) -> None:
        """Free what is held. Nothing may be called afterwards."""


class ClientEnd(Protocol):
    """Bytes of one client. `take` belongs to the take loop; `send` needs the caller's lock."""

    def take(self) -> tuple[int, bytes] | None:
        """Return the next response: sequence number and bytes; None when there is none.

        Raises:
            RosError: It could not be read; it is gone.
        """

    def send(self, payload: bytes) -> int:
        """Send a serialised request; return its sequence number.

        Raises:
            RosError: The bytes are no such message, or ROS refused them.
        """

    def close(self) -> None:
        """Free what is held. Nothing may be called afterwards."""


class Transfer(Protocol):
    """One way to move bytes, for one service type."""

    def service_end(self, service: Any) -> ServiceEnd:
        """Return the end of an rclpy service."""

    def client_end(self, client: Any) -> ClientEnd:
        """Return the end of an rclpy client."""


def choose(type_name: str) -> Transfer:
    """Return the fast way for a type, or the slow one, with a warning, where that fails its test.

    Raises:
        RosError: The type cannot be loaded.
    """
    from fogft.ros import converted, serialised, types

    service_type = types.load_service_type(type_name)
    try:
        serialised.self_test(service_type)
    except RosError as error:
        log.warning(
            "serialised services do not work here for %s (%s): large messages will be slow",
            type_name,
            error.message,
        )
        return converted.ConvertedTransfer(service_type)
    return serialised.SerialisedTransfer(service_type)
