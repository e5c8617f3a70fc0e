"""Who makes room where too many have connected that have not proved yet who they are. Pure.

One host cannot keep others out for longer than these take to greet: where the room is used up, the
oldest connection of the host that has most of them is ended.
"""

from __future__ import annotations

import ipaddress
from collections import Counter
from collections.abc import Mapping
from functools import lru_cache
from typing import TypeVar

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
