"""Drop new connections to a port in the kernel: those of some hosts, or all.

Zenoh accepts whatever comes to its port, and rests for 0.1 s after each handshake that fails. So
from whom too many are under way nothing more is to be accepted. A filter on the listening socket
(`SO_ATTACH_FILTER`, for which no privilege is needed) drops the first packet of a connection; who
meant it well sends that again after a second, or tries anew. Links that are open are other sockets:
they pass no filter that drops their packets, and nothing stands between them and Zenoh.

Owns: what the filter says. Not here: whose connections are dropped (`connection_reaper`), and the
listening sockets (`accept_loops`).
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable

from fogft.link.zenoh.replica.accept_loops import RETURN, AcceptLoops, Instruction

HOSTS_LIMIT = 32  # where more are to be kept out, all are

_LOAD_WORD, _LOAD_BYTE, _SHIFT_RIGHT, _JUMP_IF_EQUAL = 0x20, 0x30, 0x74, 0x15
_IP_HEADER = -0x100000 & 0xFFFFFFFF  # SKF_NET_OFF
_DROP, _PASS = 0, 0xFFFFFFFF


class ListenFilter:
    """What is dropped at one port of this process. For one thread."""

    def __init__(self, loops: AcceptLoops) -> None:
        self._loops = loops
        self._dropped: frozenset[str] | None = frozenset()

    def drop(self, hosts: frozenset[str] | None) -> None:
        """Drop the new connections of these hosts from now on, and of no others; None for all."""
        if hosts != self._dropped:
            code = instructions(None if hosts and len(hosts) > HOSTS_LIMIT else hosts)
            self._loops.judge([] if hosts == frozenset() else code)
            self._dropped = hosts


def instructions(hosts: Iterable[str] | None) -> list[Instruction]:
    """Return the filter that drops what comes from these hosts; None for all. Pure.

    Of an IPv6 address the network counts, its first 64 bits: who has one address has them all.
    """
    if hosts is None:
        return [(RETURN, 0, 0, _DROP)]
    addresses = [ipaddress.ip_address(host.partition("%")[0]) for host in sorted(hosts)]
    passed = (RETURN, 0, 0, _PASS)
    v4: list[Instruction] = [(_LOAD_WORD, 0, 0, _IP_HEADER + 12 & 0xFFFFFFFF)]
    v6: list[Instruction] = []
    for one in addresses:
        if one.version == 4:
            v4 += [(_JUMP_IF_EQUAL, 0, 1, int(one)), (RETURN, 0, 0, _DROP)]
        else:
            network, host = divmod(int(one) >> 64, 1 << 32)
            v6 += [
                (_LOAD_WORD, 0, 0, _IP_HEADER + 8 & 0xFFFFFFFF),
                (_JUMP_IF_EQUAL, 0, 3, network),
                (_LOAD_WORD, 0, 0, _IP_HEADER + 12 & 0xFFFFFFFF),
                (_JUMP_IF_EQUAL, 0, 1, host),
                (RETURN, 0, 0, _DROP),
            ]
    return [
        (_LOAD_BYTE, 0, 0, _IP_HEADER),
        (_SHIFT_RIGHT, 0, 0, 4),  # the version
        (_JUMP_IF_EQUAL, len(v4) + 1, 0, 6),
        *v4,
        passed,
        *v6,
        passed,
    ]
