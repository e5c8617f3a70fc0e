"""Bind a TCP port, and make room where too many have connected that have not proved who they are.

One host cannot keep others out for longer than these take to greet: where the room is used up, the
oldest connection of the host that has most of them is ended.
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
    """Return who has to go of those (oldest first) that are greeting, each with its host."""
    networks = {one: network_of(host) for one, host in greeting.items()}
    (most, _), *_ = Counter(networks.values()).most_common(1)
    return next(one for one, network in networks.items() if network == most)


@lru_cache(maxsize=1024)
def network_of(host: str) -> str:
    """Return the network of an IPv6 address, 64 bits, as its first address; else the host."""
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
