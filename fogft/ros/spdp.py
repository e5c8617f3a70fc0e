"""DDS participant discovery (SPDP) messages that fogft sends itself: RTPS 2.3, 8.5.3, 9.4.5.3.

Others keep a killed process listed for 20 seconds, DDS's lease, unless one message says that it is
gone; anybody who knows its id can send that message. A new process often misses the answers of
running ones to its first announcement: Fast DDS listens only afterwards. So a second participant,
which ROS does not see, is announced briefly, and the answers to it are passed on.

Owns: these messages and their destinations. Not here: who was killed (`fogft.proxy.robot.process`).
"""

import contextlib
import os
import re
import socket
import struct
import time

from fogft.process import on_thread
from fogft.ros.vendors import CYCLONE_DDS, FAST_DDS

PREFIX_BYTES = 12
_PARTICIPANT = b"\x00\x00\x01\xc1"
_SPDP_WRITER, _SPDP_READER = b"\x00\x01\x00\xc2", b"\x00\x01\x00\xc7"
_LITTLE_ENDIAN, _INLINE, _DATA, _KEY = 0x01, 0x02, 0x04, 0x08
_END = struct.pack("<HH", 1, 0)
_LAST = 0x7FFFFFFF  # a sequence number above any that it can have used
_GROUP = "239.255.0.1"
_LOOPBACK = "127.0.0.1"
BASE_PORT, DOMAIN_GAIN, _UNICAST_OFFSET, _ID_GAIN = 7400, 250, 10, 2
_IDS = 64  # participants of one machine that get the message, one by one
_ANSWERED_WITHIN_S = 0.3
_LOOK_S = 0.02


def is_known(prefix: bytes) -> bool:
    """Whether a participant id belongs to a middleware that understands the message."""
    return len(prefix) == PREFIX_BYTES and prefix.startswith((FAST_DDS, CYCLONE_DDS))


def _message(prefix: bytes, number: int, flags: int, parameters: bytes) -> bytes:
    body = struct.pack("<HH", 0, 16) + _SPDP_READER + _SPDP_WRITER + struct.pack("<iI", 0, number)
    body += parameters + _END
    header = b"RTPS\x02\x03" + prefix[:2] + prefix
    return header + struct.pack("<BBH", 0x15, _LITTLE_ENDIAN | flags, len(body)) + body


def gone(prefix: bytes) -> bytes:
    """Return the DDS disposal message of the participant with this id prefix."""
    guid = prefix + _PARTICIPANT
    parameters = struct.pack("<HH", 0x70, 16) + guid  # PID_KEY_HASH
    parameters += struct.pack("<HH", 0x71, 4) + b"\x00\x00\x00\x03"  # disposed, unregistered
    key = b"\x00\x03\x00\x00" + struct.pack("<HH", 0x50, 16) + guid
    return _message(prefix, _LAST, _INLINE | _KEY, parameters + _END + key)


def _here(prefix: bytes, port: int) -> bytes:
    """Return the announcement of a participant that takes answers at a port of this machine."""
    at = struct.pack("<iI12x", 1, port) + socket.inet_aton(_LOOPBACK)
    parameters = {
        0x15: b"\x02\x03\x00\x00",  # protocol version
        0x16: FAST_DDS + b"\x00\x00",  # vendor
        0x50: prefix + _PARTICIPANT,
        0x32: at,  # for discovery
        0x31: at,  # for data
        0x02: struct.pack("<iI", 1, 0),  # its lease in seconds
        0x58: struct.pack("<I", 3),  # it has participant discovery only
    }
    told = b"".join(struct.pack("<HH", id, len(value)) + value for id, value in parameters.items())
    return _message(prefix, 1, _DATA, b"\x00\x03\x00\x00" + told)


def domain_of(port: int) -> int:
    """Return the domain that a port belongs to; negative for ports below all domains."""
    return (port - BASE_PORT) // DOMAIN_GAIN


def first_port(domain_id: int) -> int:
    """Return the UDP discovery port of a machine's first participant in a domain."""
    return BASE_PORT + DOMAIN_GAIN * domain_id + _UNICAST_OFFSET


def _send(message: bytes, domain_id: int) -> None:
    _tell(message, domain_id, _LOOPBACK)
    for peer in filter(None, re.split(r"[;\s]+", os.environ.get("ROS_STATIC_PEERS", ""))):
        on_thread(_tell, message, domain_id, peer, name="peer")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
        with contextlib.suppress(OSError):
            for index, _ in socket.if_nameindex():
                with contextlib.suppress(OSError):
                    through = struct.pack("=4s4si", b"", b"", index)
                    sending.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, through)
                    sending.sendto(message, (_GROUP, BASE_PORT + DOMAIN_GAIN * domain_id))


def _tell(message: bytes, domain_id: int, host: str) -> None:
    with (
        contextlib.suppress(OSError, UnicodeError),  # the name is unknown
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending,
    ):
        address = socket.gethostbyname(host)  # without a network that takes seconds
        for port in range(first_port(domain_id), 1 << 16, _ID_GAIN)[:_IDS]:
            with contextlib.suppress(OSError):  # a firewall may allow only some ports
                sending.sendto(message, (address, port))


def declare_gone(prefix: bytes, domain_id: int) -> None:
    """Send the disposal message of the killed participant with this id prefix."""
    if is_known(prefix):
        _send(gone(prefix), domain_id)


class Introduction:
    """Helps this process's new participants discover a domain's running ones, on a thread."""

    def __init__(self, domain_id: int) -> None:
        self._domain_id = domain_id
        self._closed = False
        self._thread = on_thread(self._run, name="introduction")

    def close(self) -> None:
        """Stop it and wait until it has ended; it also ends by itself soon. Idempotent."""
        self._closed = True
        self._thread.join()

    def _run(self) -> None:
        prefix = FAST_DDS + os.urandom(PREFIX_BYTES - len(FAST_DDS))
        with (
            contextlib.suppress(OSError),  # no descriptor: discovery then takes longer
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock,
        ):
            sock.bind((_LOOPBACK, 0))
            sock.settimeout(_LOOK_S)
            ours = _own_ports(self._domain_id)
            _send(_here(prefix, sock.getsockname()[1]), self._domain_id)
            end = time.monotonic() + _ANSWERED_WITHIN_S
            while not self._closed and time.monotonic() < end:
                with contextlib.suppress(TimeoutError):
                    answer = sock.recv(1 << 16).replace(prefix, bytes(PREFIX_BYTES))  # to anyone
                    for port in ours:
                        sock.sendto(answer, (_LOOPBACK, port))
            _send(gone(prefix), self._domain_id)


def _own_ports(domain_id: int) -> list[int]:
    """Return the discovery ports of this process's participants in a domain."""
    sockets = set()
    for descriptor in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            sockets.add(os.readlink(f"/proc/self/fd/{descriptor}"))
    first = first_port(domain_id)
    discovery = range(first, first + DOMAIN_GAIN - _UNICAST_OFFSET, _ID_GAIN)
    with open("/proc/self/net/udp") as table:
        lines = [line.split() for line in table][1:]
    ours = [line[1] for line in lines if f"socket:[{line[9]}]" in sockets]
    return [port for address in ours if (port := int(address.partition(":")[2], 16)) in discovery]
