"""Bind a TCP port: of the rendezvous, of what replicas dial in to, and of a replica."""

from __future__ import annotations

import socket

from fogft.errors import WireError


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
