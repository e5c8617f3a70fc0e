"""Announce to a DDS domain, on its behalf, that a killed process is gone.

Others go on believing in a killed process for 20 seconds, DDS's lease: `service_is_ready` stays
true, and a client with `KEEP_ALL` keeps its requests for it. A process that ends well takes its
leave with one message, which whoever knows its id can send as well: RTPS 2.3, 8.5.3 and 9.4.5.3.

Owns: that message, and where it goes. Not here: who was killed (`fogft.proxy.robot.process`).
"""

from __future__ import annotations

import contextlib
import os
import re
import socket
import struct
from collections.abc import Iterator, Mapping

PREFIX_BYTES = 12
_VENDORS = (b"\x01\x0f", b"\x01\x10")  # Fast DDS, CycloneDDS: who else keeps to this is not known
_PARTICIPANT = b"\x00\x00\x01\xc1"
_SPDP_WRITER, _SPDP_READER = b"\x00\x01\x00\xc2", b"\x00\x01\x00\xc7"
_LAST = 0x7FFFFFFF  # a number above all that it can have used
_GROUP = "239.255.0.1"
_BASE_PORT, _DOMAIN_GAIN, _UNICAST_OFFSET, _ID_GAIN = 7400, 250, 10, 2
_IDS = 64  # participants of one machine that are told, one by one


def is_known(prefix: bytes) -> bool:
    """Whether a participant id is of a middleware that understands the message."""
    return len(prefix) == PREFIX_BYTES and prefix.startswith(_VENDORS)


def message_of(prefix: bytes) -> bytes:
    """Return the DDS disposal message of the participant with this id prefix."""
    guid = prefix + _PARTICIPANT
    parameters = struct.pack("<HH", 0x70, 16) + guid  # PID_KEY_HASH
    parameters += struct.pack("<HH", 0x71, 4) + b"\x00\x00\x00\x03"  # disposed, unregistered
    parameters += struct.pack("<HH", 1, 0)
    key = b"\x00\x03\x00\x00" + struct.pack("<HH", 0x50, 16) + guid + struct.pack("<HH", 1, 0)
    body = struct.pack("<HH", 0, 16) + _SPDP_READER + _SPDP_WRITER + struct.pack("<iI", 0, _LAST)
    body += parameters + key
    flags = 0x01 | 0x02 | 0x08  # little endian, inline parameters, a key
    header = b"RTPS\x02\x03" + prefix[:2] + prefix
    return header + struct.pack("<BBH", 0x15, flags, len(body)) + body


def declare_gone(
    prefix: bytes, domain_id: int | None, environ: Mapping[str, str] = os.environ
) -> bool:
    """Send a killed participant's disposal message; return whether it was sent.

    Args:
        prefix: The first 12 bytes of its id.
        domain_id: The ROS domain; None for ``ROS_DOMAIN_ID``, else 0.
        environ: Where ROS's variables are.
    """
    if not is_known(prefix):
        return False
    if domain_id is None:
        written = environ.get("ROS_DOMAIN_ID") or "0"
        domain_id = int(written) if written.isdecimal() else 0
    port = _BASE_PORT + _DOMAIN_GAIN * domain_id
    message = message_of(prefix)
    peers = re.split(r"[;\s]+", environ.get("ROS_STATIC_PEERS", ""))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
        for host in filter(None, ["127.0.0.1", *peers]):
            for id in range(_IDS):
                with contextlib.suppress(OSError):
                    to = port + _UNICAST_OFFSET + _ID_GAIN * id
                    sending.sendto(message, (host, to))
        for index in _interfaces():
            with contextlib.suppress(OSError):
                through = struct.pack("=4s4si", b"", b"", index)
                sending.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, through)
                sending.sendto(message, (_GROUP, port))
    return True


def _interfaces() -> Iterator[int]:
    with contextlib.suppress(OSError):
        yield from (index for index, _ in socket.if_nameindex())
