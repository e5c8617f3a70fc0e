"""Which hosts a replica's port accepts, and which unauthenticated connections it closes. Pure.

A stranger is a connection that has not authenticated yet. Zenoh pauses for 0.1 s after each failed
handshake, so only a few strangers per host (an IPv4 address or an IPv6 network) are accepted, and
they are closed one by one. The sockets are in `connection_reaper` and `listen_filter`.
"""

from collections import Counter
from collections.abc import Collection, Mapping

from fogft.link.zenoh.sockets import Address
from fogft.records.accepting import network_of

PATIENCE_S = 5.0  # longer than Zenoh takes to accept or give up on a peer that talks
STRANGERS_LIMIT = 16
HOST_LIMIT = 8  # strangers of one host: from then on none of its connections are accepted
SHUT_LIMIT = 32  # strangers of all hosts still accepted: from then on nothing is accepted
LEAST_AGE_S = 0.5  # in a flood, even young ones are closed, but not during their handshake
KEPT_OUT_S = 10.0  # how long a host is kept out, unless a robot there has a link
END_EVERY_S = 0.12  # one at a time: longer than Zenoh's pause


class Door:
    """The admission state of one port. Bounded by the number of concurrent connections."""

    def __init__(self) -> None:
        self._first_seen: dict[Address, float] = {}
        self._until: dict[str, float] = {}  # hosts that are kept out
        self._ended_at = float("-inf")

    def look(
        self, strangers: Collection[Address], linked: Collection[Address], now: float
    ) -> Address | None:
        """Take the current connections; return the stranger to close now, or None."""
        self._first_seen = {peer: self._first_seen.get(peer, now) for peer in strangers}
        known = {network_of(host) for host, _ in linked}
        self._until = {
            host: until for host, until in self._until.items() if now < until and host not in known
        }
        self._until.update((host, now + KEPT_OUT_S) for host in full(strangers))
        gone = condemned(self._first_seen, now)
        if not gone or now - self._ended_at < END_EVERY_S:
            return None
        self._ended_at = now
        return gone[0]

    @property
    def kept_out(self) -> frozenset[str] | None:
        """Hosts whose new connections are dropped; None for all hosts."""
        others = [host for host, _ in self._first_seen if network_of(host) not in self._until]
        return None if len(others) >= SHUT_LIMIT else frozenset(self._until)


def full(strangers: Collection[Address]) -> set[str]:
    """Return the hosts with too many unauthenticated connections."""
    of_host = Counter(network_of(host) for host, _ in strangers)
    return {host for host, count in of_host.items() if count >= HOST_LIMIT}


def condemned(strangers: Mapping[Address, float], now: float) -> list[Address]:
    """Return which strangers (address -> when first seen) to close, oldest first."""
    by_age = sorted(strangers, key=lambda peer: strangers[peer])
    surplus = set(by_age[: max(0, len(by_age) - STRANGERS_LIMIT)])
    for host in full(strangers):  # others who share its address must get a turn
        of_host = [peer for peer in by_age if network_of(peer[0]) == host]
        surplus.update(of_host[: len(of_host) - HOST_LIMIT // 2])
    return [
        peer
        for peer in by_age
        if now - strangers[peer] >= (LEAST_AGE_S if peer in surplus else PATIENCE_S)
    ]
