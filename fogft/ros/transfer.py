"""How the bytes of a message get out of and into ROS: the seam below the node.

Two implementations: `serialised` (fast, over rcl), and where that fails its test
`CONVERTED` (over rclpy's own messages: same bytes, same errors, no ctypes).

Owns: the contract of the two and the choice.
Not here: the thread, the wait set and the pending requests (`node`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from fogft.errors import RosError
from fogft.ros.messages import from_bytes, to_bytes

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


class _ConvertedServiceEnd(ServiceEnd):
    """Bytes of a service by way of rclpy's messages."""

    def __init__(self, service: Any, service_type: Any) -> None:
        self._handle = service.handle
        self._type = service_type

    def take(self) -> tuple[bytes, Any] | None:
        try:
            request, header = self._handle.service_take_request(self._type.Request)
        except Exception as error:
            raise RosError(f"a request cannot be taken: {error}") from error
        return None if header is None else (to_bytes(request), header.request_id)

    def respond(self, handle: Any, payload: bytes) -> None:
        response = from_bytes(payload, self._type.Response)
        try:
            self._handle.service_send_response(response, handle)
        except Exception as error:
            raise RosError(f"a response cannot be sent: {error}") from error


class _ConvertedClientEnd(ClientEnd):
    """Bytes of a client by way of rclpy's messages."""

    def __init__(self, client: Any, service_type: Any) -> None:
        self._handle = client.handle
        self._type = service_type

    def take(self) -> tuple[int, bytes] | None:
        try:
            header, response = self._handle.take_response(self._type.Response)
        except Exception as error:
            raise RosError(f"a response cannot be taken: {error}") from error
        if header is None:
            return None
        return header.request_id.sequence_number, to_bytes(response)

    def send(self, payload: bytes) -> int:
        request = from_bytes(payload, self._type.Request)
        try:
            return int(self._handle.send_request(request))
        except Exception as error:
            raise RosError(f"a request cannot be sent: {error}") from error


class Ends(NamedTuple):
    """One way to move bytes: made of an rclpy service, or client, and its type."""

    service: Callable[[Any, Any], ServiceEnd]
    client: Callable[[Any, Any], ClientEnd]


CONVERTED = Ends(_ConvertedServiceEnd, _ConvertedClientEnd)


def choose(service_type: Any, type_name: str) -> Ends:
    """Return the fast way for a type; the slow one, with a warning, if that fails its test."""
    from fogft.ros import serialised

    try:
        serialised.self_test(service_type)
    except RosError as error:
        log.warning(
            "serialised services do not work here for %s (%s): large messages will be slow",
            type_name,
            error.message,
        )
        return CONVERTED
    return Ends(serialised.SerialisedServiceEnd, serialised.SerialisedClientEnd)
