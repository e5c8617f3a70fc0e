"""Identify a request that CycloneDDS received, and its sender.

Under CycloneDDS a request's header holds two numbers: the client's own, and one that only this
process uses for the writer of its requests. Only CycloneDDS can resolve the latter.

Owns: the meaning of that header. Not here: which node a writer belongs to (`node`).
"""

import os
import sys
from ctypes import CDLL, c_int32, c_size_t, c_uint32, c_uint64, c_void_p, string_at
from functools import lru_cache
from typing import Any

from fogft.ros.rcl import declared

MIDDLEWARE = "rmw_cyclonedds_cpp"
LIBRARY = "libddsc.so.0"  # of CycloneDDS 0.x, which every ROS distribution up to Kilted has
_IDENTIFIER_BYTES = 16
_OF_THIS_PROCESS = slice(8, 16)  # of a request's handle
_MOST = 1024  # the maximum number of children read per entity
_SIGNATURES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "dds_lookup_participant": (c_int32, (c_uint32, c_void_p, c_size_t)),
    "dds_get_children": (c_int32, (c_int32, c_void_p, c_size_t)),
    "dds_get_matched_publication_data": (c_void_p, (c_int32, c_uint64)),
    "dds_builtintopic_free_endpoint": (None, (c_void_p,)),
}


@lru_cache(maxsize=1)
def loaded_library() -> Any:
    """Return the CycloneDDS library if this process has loaded it in this version, else None."""
    try:
        return declared(CDLL(LIBRARY, mode=os.RTLD_NOLOAD | os.RTLD_NOW), _SIGNATURES)
    except (OSError, AttributeError):
        return None


def identity(handle: bytes) -> bytes:
    """Return the part of a request's handle that is the same in each process that received it."""
    return handle[: _OF_THIS_PROCESS.start] + handle[_OF_THIS_PROCESS.stop :]


def writer_of(client: bytes, domain_id: int) -> bytes:
    """Return the GID of the writer of a client's requests; empty if unknown.

    `client` is the first 16 bytes of the handle of a request that came in that ROS domain.
    """
    library = loaded_library()
    if library is None:
        return b""
    number = int.from_bytes(client[_OF_THIS_PROCESS], sys.byteorder)
    for participant in _entities(library.dds_lookup_participant, domain_id):
        for subscriber in _entities(library.dds_get_children, participant):
            for reader in _entities(library.dds_get_children, subscriber):
                # NULL if it is not a reader, or reads another topic.
                found = library.dds_get_matched_publication_data(reader, number)
                if found:
                    try:
                        return string_at(found, _IDENTIFIER_BYTES)
                    finally:
                        library.dds_builtintopic_free_endpoint(found)
    return b""


def _entities(find: Any, of: int) -> list[int]:
    found = (c_int32 * _MOST)()
    count: int = find(of, found, _MOST)
    return list(found[: max(0, min(count, _MOST))])
