"""The few functions of rcl and rmw that serialised services need, through ctypes.

These are documented, stable C interfaces of ROS 2. One handle on ``librcl`` finds them all,
whatever middleware is loaded: the dynamic linker searches a library's dependencies too. Each
function is loaded twice: one holds the global interpreter lock, one releases it during the call.

Owns: names, argument types, return codes, C structures, error texts.
Not here: when to call them (`serialised`).
"""

import ctypes
from collections.abc import Mapping
from ctypes import (
    CDLL,
    POINTER,
    PYFUNCTYPE,
    PyDLL,
    Structure,
    c_char,
    c_char_p,
    c_int32,
    c_int64,
    c_size_t,
    c_void_p,
    py_object,
)
from functools import lru_cache
from typing import Any

from fogft.errors import RosError

OK = 0
TIMEOUT = 2  # of a response: the client was not discovered within ROS's wait
CLIENT_TAKE_FAILED = 501  # nothing was there to take
SERVICE_TAKE_FAILED = 601


class RequestHeader(Structure):
    """``rmw_request_id_t``: which client asked, and its sequence number."""

    _fields_ = (("writer_guid", c_char * 16), ("sequence_number", c_int64))


class _Allocator(Structure):
    _fields_ = tuple(
        (name, c_void_p)
        for name in ("allocate", "deallocate", "reallocate", "zero_allocate", "state")
    )


_LENGTHS = (("length", c_size_t), ("capacity", c_size_t), ("allocator", _Allocator))


class InputBytes(Structure):
    """``rcutils_uint8_array_t`` over the bytes of a Python object, which it keeps alive."""

    _fields_ = (("buffer", c_char_p), *_LENGTHS)


class OutputBytes(Structure):
    """``rcutils_uint8_array_t`` that rmw grows as it needs."""

    _fields_ = (("buffer", POINTER(c_char)), *_LENGTHS)


class _ErrorString(Structure):
    _fields_ = (("text", c_char * 1024),)


_SIGNATURES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "rcl_take_request": (c_int32, (c_void_p, POINTER(RequestHeader), c_void_p)),
    "rcl_take_response": (c_int32, (c_void_p, POINTER(RequestHeader), c_void_p)),
    "rcl_send_request": (c_int32, (c_void_p, c_void_p, POINTER(c_int64))),
    "rcl_send_response": (c_int32, (c_void_p, c_char_p, c_void_p)),
    "rcl_service_get_service_name": (c_char_p, (c_void_p,)),
    "rcl_client_get_service_name": (c_char_p, (c_void_p,)),
    "rmw_serialize": (c_int32, (c_void_p, c_void_p, c_void_p)),
    "rmw_deserialize": (c_int32, (c_void_p, c_void_p, c_void_p)),
    "rcutils_get_default_allocator": (_Allocator, ()),
    "rcutils_uint8_array_fini": (c_int32, (c_void_p,)),
    "rcutils_get_error_string": (_ErrorString, ()),
    "rcutils_reset_error": (None, ()),
}


def declared(library: CDLL, signatures: Mapping[str, Any] = _SIGNATURES) -> CDLL:
    """Declare the result and argument types of a library's functions; return the library."""
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


@lru_cache(maxsize=1)
def load() -> tuple[CDLL, CDLL]:
    """Load the functions: a set that holds the GIL, and a set that releases it.

    Raises RosError: The library or one of its functions is missing.
    """
    try:
        import rclpy.impl.implementation_singleton  # noqa: F401  loads librcl itself

        return declared(PyDLL("librcl.so")), declared(CDLL("librcl.so"))
    except (OSError, AttributeError, ImportError) as error:
        raise RosError(f"the C library of ROS 2 cannot be used: {error}") from error


def error_text() -> str:
    """Return rcl's last error of this thread, and clear it."""
    held, _ = load()
    text: bytes = held.rcutils_get_error_string().text
    held.rcutils_reset_error()
    return text.decode(errors="replace").strip()


_capsule_name = PYFUNCTYPE(c_char_p, py_object)(("PyCapsule_GetName", ctypes.pythonapi))
_capsule_pointer = PYFUNCTYPE(c_void_p, py_object, c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)


def address(capsule: Any) -> int:
    """Return the C pointer that a Python capsule holds."""
    pointer: int | None = _capsule_pointer(capsule, _capsule_name(capsule))
    if not pointer:
        raise RosError("a type support of ROS 2 is empty")
    return pointer


create_function = PYFUNCTYPE(c_void_p)
destroy_function = PYFUNCTYPE(None, c_void_p)
