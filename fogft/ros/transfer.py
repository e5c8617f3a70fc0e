"""How the bytes of a message get out of and into ROS: the seam below the node.

Two implementations: `serialised` (fast, over rcl), and where that fails its test
`CONVERTED` (over rclpy's own messages: same bytes, same errors, no ctypes).

`take` belongs to the take loop and raises RosError for what could not be read, which is gone;
sending needs the caller's lock, and raises RosError for bytes that are no such message, or that ROS
refused.

Owns: the choice.
Not here: the thread, the wait set and the pending requests (`node`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from fogft.errors import RosError
from fogft.ros.messages import from_bytes, to_bytes

if TYPE_CHECKING:
    from fogft.ros.serialised import SerialisedClientEnd, SerialisedServiceEnd

log = logging.getLogger(__name__)


class _Converted:
    def __init__(self, entity: Any, service_type: Any) -> None:
        self._handle = entity.handle
        self._type = service_type

    def close(self) -> None:
        """Do nothing: nothing is held."""


class ConvertedServiceEnd(_Converted):
    """`SerialisedServiceEnd` by way of rclpy's messages."""

    def take(self) -> tuple[bytes, Any] | None:
        """Return the next serialised request and its handle. Raises RosError."""
        try:
            request, header = self._handle.service_take_request(self._type.Request)
        except Exception as error:
            raise RosError(f"a request cannot be taken: {error}") from error
        return None if header is None else (to_bytes(request), header.request_id)

    def respond(self, handle: Any, payload: bytes) -> None:
        """Send a serialised response. Raises RosError."""
        response = from_bytes(payload, self._type.Response)
        try:
            self._handle.service_send_response(response, handle)
        except Exception as error:
            raise RosError(f"a response cannot be sent: {error}") from error


class ConvertedClientEnd(_Converted):
    """`SerialisedClientEnd` by way of rclpy's messages."""

    def take(self) -> tuple[int, bytes] | None:
        """Return the next response: sequence number and bytes. Raises RosError."""
        try:
            header, response = self._handle.take_response(self._type.Response)
        except Exception as error:
            raise RosError(f"a response cannot be taken: {error}") from error
        if header is None:
            return None
        return header.request_id.sequence_number, to_bytes(response)

    def send(self, payload: bytes) -> int:
        """Send a serialised request; return its sequence number. Raises RosError."""
        request = from_bytes(payload, self._type.Request)
        try:
            return int(self._handle.send_request(request))
        except Exception as error:
            raise RosError(f"a request cannot be sent: {error}") from error


ServiceEnd: TypeAlias = "SerialisedServiceEnd | ConvertedServiceEnd"
ClientEnd: TypeAlias = "SerialisedClientEnd | ConvertedClientEnd"


class Ends(NamedTuple):
    """One way to move bytes: made of an rclpy service, or client, and its type."""

    service: Callable[[Any, Any], ServiceEnd]
    client: Callable[[Any, Any], ClientEnd]


CONVERTED = Ends(ConvertedServiceEnd, ConvertedClientEnd)


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
