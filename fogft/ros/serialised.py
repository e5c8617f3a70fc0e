"""Take and send serialised requests and responses without Python messages.

`take` belongs to the take loop and raises RosError for an unreadable message, which is lost;
callers must hold a lock to send. Design: docs/design/serialised-services.md.

GIL: held for messages below `LARGE_BYTES`, released above, and while ROS may wait for room.
A take goes by the size of the previous message.

Owns: C messages and buffers. Not here: threads and locks (`node`), types (`types`), C signatures
(`rcl`).
"""

from ctypes import CDLL, addressof, byref, c_int64
from functools import lru_cache
from typing import Any

from fogft.errors import RosError, Unreadable
from fogft.ros import rcl
from fogft.ros.port import NotFoundYet
from fogft.ros.types import load_message_type, shape

LARGE_BYTES = 256 * 1024


class CMessage:
    """A C message of a type, converted from and to bytes. Not thread-safe."""

    def __init__(self, message_type: Any) -> None:
        kind = type(message_type)
        self._held, self._released = rcl.load()
        self.functions = self._held  # by the size of the last message written
        self._type_support = rcl.address(kind._TYPE_SUPPORT)
        self._destroy = rcl.destroy_function(rcl.address(kind._DESTROY_ROS_MESSAGE))
        self._name = message_type.__name__
        allocator = self._held.rcutils_get_default_allocator()
        self._input = rcl.InputBytes(None, 0, 0, allocator)
        self._input_address = addressof(self._input)
        self._output = rcl.OutputBytes(None, 0, 0, allocator)
        self._output_address = addressof(self._output)
        self._shape = shape(message_type)
        self.address: int = rcl.create_function(rcl.address(kind._CREATE_ROS_MESSAGE))()
        if not self.address:
            raise RosError(f"no memory for a {self._name}")

    def check(self, payload: bytes) -> None:
        """Raise Unreadable if the bytes are no such message; every middleware rejects the same.

        Takes up to 0.1 s per MB. Needs no lock.
        """
        fault = self._shape.fault(payload)
        if fault:
            raise Unreadable(f"{len(payload)} bytes are not a serialised {self._name}: {fault}")

    def read(self, payload: bytes, *, checked: bool = False) -> CDLL:
        """Fill the message from serialised bytes; return the functions to send it with.

        Raises Unreadable: They are not such a message; the message's content is now undefined.
        """
        if not checked:
            self.check(payload)
        size = len(payload)
        source = self._input
        source.buffer = payload
        source.length = source.capacity = size
        functions = self._held if size < LARGE_BYTES else self._released
        code = functions.rmw_deserialize(self._input_address, self._type_support, self.address)
        source.buffer = None
        if code != rcl.OK:
            reason = rcl.error_text()
            raise Unreadable(f"{size} bytes are not a serialised {self._name}: {reason}")
        return functions

    def write(self) -> bytes:
        """Return the message as serialised bytes. Raises RosError: out of memory."""
        code = self.functions.rmw_serialize(self.address, self._type_support, self._output_address)
        if code != rcl.OK:
            raise RosError(f"a {self._name} cannot be serialised: {rcl.error_text()}")
        payload: bytes = self._output.buffer[: self._output.length]
        self.functions = self._held if len(payload) < LARGE_BYTES else self._released
        return payload

    def close(self) -> None:
        """Free the message and the buffer. Idempotent."""
        if self.address:
            self._destroy(self.address)
            self.address = 0
            self._held.rcutils_uint8_array_fini(self._output_address)


class _End:
    """The common part of both ends: rcl handle, a message to take into, one to send from."""

    def __init__(self, entity: Any, taken_type: Any, sent_type: Any) -> None:
        self._held, self._released = rcl.load()
        self._handle = entity.handle  # keeps the rcl handle alive
        self._pointer: int = entity.handle.pointer
        self._taken = CMessage(taken_type)
        self._taken_address = self._taken.address
        self._sent = CMessage(sent_type)
        self._sent_address = self._sent.address
        self._refused = False  # the last send; the next may wait for room, up to 0.1 s
        self._header = rcl.RequestHeader()
        self._header_reference = byref(self._header)

    def _unsent(self, code: int, what: str) -> RosError:
        kind = NotFoundYet if code == rcl.TIMEOUT else RosError
        return kind(f"a {what} cannot be sent: {rcl.error_text()}")

    def _check_name(self, found: bytes | None, name: str) -> None:
        """Verify that the handle's address is that of the rcl entity of this name."""
        if found is None or not found.decode().endswith(name.lstrip("~/")):
            raise RosError(f"rclpy's handle of `{name}` is not rcl's")

    def close(self) -> None:
        self._taken.close()
        self._sent.close()


class ServiceEnd(_End):
    """The server's end of a service."""

    def __init__(self, service: Any, service_type: Any) -> None:
        super().__init__(service, service_type.Request, service_type.Response)
        name = self._held.rcl_service_get_service_name(self._pointer)
        self._check_name(name, service.srv_name)

    def take(self) -> tuple[bytes, bytes] | None:
        """Return the next serialised request and the bytes of its header; None if none waits."""
        code = self._taken.functions.rcl_take_request(
            self._pointer, self._header_reference, self._taken_address
        )
        if code == rcl.OK:
            return self._taken.write(), bytes(self._header)
        if code == rcl.SERVICE_TAKE_FAILED:
            return None
        raise RosError(f"a request cannot be taken: {rcl.error_text()}")

    def respond(self, handle: bytes, payload: bytes) -> None:
        """Send a serialised response."""
        functions = self._sent.read(payload)
        if self._refused:
            functions = self._released
        code = functions.rcl_send_response(self._pointer, handle, self._sent_address)
        self._refused = code != rcl.OK
        if self._refused:
            raise self._unsent(code, "response")


class ClientEnd(_End):
    """The client's end of a service."""

    def __init__(self, client: Any, service_type: Any) -> None:
        super().__init__(client, service_type.Response, service_type.Request)
        name = self._held.rcl_client_get_service_name(self._pointer)
        self._check_name(name, client.srv_name)
        self._ticket = c_int64()
        self._ticket_reference = byref(self._ticket)
        self.check = self._sent.check

    def take(self) -> tuple[int, bytes] | None:
        """Return the next response, as sequence number and bytes; None if none waits."""
        code = self._taken.functions.rcl_take_response(
            self._pointer, self._header_reference, self._taken_address
        )
        if code == rcl.OK:
            return self._header.sequence_number, self._taken.write()
        if code == rcl.CLIENT_TAKE_FAILED:
            return None
        raise RosError(f"a response cannot be taken: {rcl.error_text()}")

    def send(self, payload: bytes) -> int:
        """Send a serialised request that was checked; return its sequence number."""
        functions = self._sent.read(payload, checked=True)
        if self._refused:
            functions = self._released
        code = functions.rcl_send_request(self._pointer, self._sent_address, self._ticket_reference)
        self._refused = code != rcl.OK
        if self._refused:
            raise self._unsent(code, "request")
        return self._ticket.value


@lru_cache(maxsize=1)
def self_test() -> None:
    """Once per process, check that a message converted here and back equals rclpy's.

    Both are compared after deserialising, because padding between fields is arbitrary.

    Raises RosError: This path does not work with the installed ROS 2.
    """
    from rclpy.serialization import deserialize_message, serialize_message

    parameter = load_message_type("rcl_interfaces/msg/Parameter")
    expected = parameter(name="a")
    expected.value.string_array_value = ["b", ""]
    message = CMessage(parameter)
    try:
        message.read(bytes(serialize_message(expected)))
        written = message.write()
    finally:
        message.close()
    if deserialize_message(written, parameter) != expected:
        raise RosError("a message came back changed from the C library of ROS 2")
