"""Drop new connections to a port in the kernel, from some hosts or from all.

A filter on the listening socket (`SO_ATTACH_FILTER`, which needs no privilege) drops the first
packet of a connection; a well-behaved peer resends it after a second, or reconnects. Open links
have their own sockets and are not affected. `door` decides whose connections are dropped.
"""

import contextlib
import ctypes
import ipaddress
import socket
import struct
import time
from collections.abc import Iterable

from fogft import poll
from fogft.link.zenoh import sockets

HOSTS_LIMIT = 32  # if more are to be kept out, all hosts are
WAITING_LIMIT = 4  # the listen backlog: Zenoh accepts at once, except during its pauses

_ATTACH, _DETACH = 26, 27  # SO_ATTACH_FILTER and SO_DETACH_FILTER of asm-generic/socket.h
# Classic BPF (linux/filter.h): the code, the jump offsets if true and if false, and a constant.
_INSTRUCTION = struct.Struct("@HBBI")
_LOAD_WORD, _LOAD_BYTE, _SHIFT_RIGHT, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x30, 0x74, 0x15, 0x06
_IP_HEADER = -0x100000 & 0xFFFFFFFF  # SKF_NET_OFF
_DROP, _PASS = 0, 0xFFFFFFFF

Instruction = tuple[int, int, int, int]


class ListenFilter:
    """The packet filter on one port of this process. For one thread."""

    def __init__(self, port: int) -> None:
        self._listening = sockets.listening(port)
        self._dropped: frozenset[str] | None = frozenset()
        if self._listening is not None:
            with contextlib.suppress(OSError):  # it stopped listening
                self._listening.listen(WAITING_LIMIT)

    def wait(self, timeout_s: float) -> bool:
        """Wait for a connection, with a time limit; return whether one came."""
        if self._listening is None:
            time.sleep(timeout_s)
            return False
        return poll.is_ready(self._listening, timeout_s)

    def turn_away(self) -> None:
        """Close the connections that Zenoh has not accepted yet."""
        if self._listening is None:
            return
        self._listening.setblocking(False)  # as it is for Zenoh
        with contextlib.suppress(OSError):  # none is waiting any more
            while True:
                connection, _ = self._listening.accept()
                sockets.abort(connection)
                connection.close()

    def drop(self, hosts: frozenset[str] | None) -> None:
        """From now on, drop new connections from exactly these hosts; None for all hosts."""
        if hosts == self._dropped or self._listening is None:
            return
        hosts = None if hosts is not None and len(hosts) > HOSTS_LIMIT else hosts
        with contextlib.suppress(OSError):  # it stopped listening
            if hosts == frozenset():
                self._listening.setsockopt(socket.SOL_SOCKET, _DETACH, 0)
            else:
                code = b"".join(_INSTRUCTION.pack(*one) for one in instructions(hosts))
                held = ctypes.create_string_buffer(code, len(code))
                program = struct.pack("@HP", len(code) // _INSTRUCTION.size, ctypes.addressof(held))
                self._listening.setsockopt(socket.SOL_SOCKET, _ATTACH, program)
            self._dropped = hosts

    def close(self) -> None:
        """Release the port: close our duplicate of its socket."""
        if self._listening is not None:
            self._listening.close()


def instructions(hosts: Iterable[str] | None) -> list[Instruction]:
    """Return the BPF filter that drops packets from these hosts; None for all. Pure.

    An IPv6 address stands for its network, the first 64 bits: whoever has one address has all.
    """
    if hosts is None:
        return [(_RETURN, 0, 0, _DROP)]
    addresses = [ipaddress.ip_address(host.partition("%")[0]) for host in sorted(hosts)]
    passed = (_RETURN, 0, 0, _PASS)
    v4: list[Instruction] = [(_LOAD_WORD, 0, 0, _IP_HEADER + 12 & 0xFFFFFFFF)]
    v6: list[Instruction] = []
    for one in addresses:
        if one.version == 4:
            v4 += [(_JUMP_IF_EQUAL, 0, 1, int(one)), (_RETURN, 0, 0, _DROP)]
        else:
            network, host = divmod(int(one) >> 64, 1 << 32)
            v6 += [
                (_LOAD_WORD, 0, 0, _IP_HEADER + 8 & 0xFFFFFFFF),
                (_JUMP_IF_EQUAL, 0, 3, network),
                (_LOAD_WORD, 0, 0, _IP_HEADER + 12 & 0xFFFFFFFF),
                (_JUMP_IF_EQUAL, 0, 1, host),
                (_RETURN, 0, 0, _DROP),
            ]
    return [
        (_LOAD_BYTE, 0, 0, _IP_HEADER),
        (_SHIFT_RIGHT, 0, 0, 4),  # the IP version
        (_JUMP_IF_EQUAL, len(v4) + 1, 0, 6),
        *v4,
        passed,
        *v6,
        passed,
    ]
