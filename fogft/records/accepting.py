"""Bind a TCP port, and make room if too many connections are not authenticated yet.

One host cannot keep others out for longer than their handshakes take: if all places are taken, the
oldest connection of the host with the most connections is closed.
"""

import ipaddress
import socket
from collections import Counter
from collections.abc import Mapping
from functools import lru_cache
from typing import TypeVar

from fogft.errors import WireError

T = TypeVar("T")


def oldest_of_most(greeting: Mapping[T, str]) -> T:
    """Return the connection to close, of those in a handshake (oldest first) with their hosts."""
    networks = {one: network_of(host) for one, host in greeting.items()}
    (most, _), *_ = Counter(networks.values()).most_common(1)
    return next(one for one, network in networks.items() if network == most)


@lru_cache(maxsize=1024)
def network_of(host: str) -> str:
    """Return the /64 network of an IPv6 address, as its first address; else the host."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if address.version == 4:
        return host
    return str(ipaddress.IPv6Address(int(address) >> 64 << 64))


def listening(endpoint: str) -> socket.socket:
    """Return a socket that listens at ``host:port``; port 0 for any free one. Raises WireError."""
    host, _, port = endpoint.rpartition(":")
    is_v6 = ":" in host
    try:
        return socket.create_server(
            (host.strip("[]"), int(port)),
            family=socket.AF_INET6 if is_v6 else socket.AF_INET,
            backlog=128,
            dualstack_ipv6=is_v6,
        )
    except (OSError, ValueError, OverflowError) as error:
        words = getattr(error, "strerror", None) or str(error)
        raise WireError(
            f"cannot listen at `{endpoint}`: {words}", "give `host:port` with a free port"
        ) from error
