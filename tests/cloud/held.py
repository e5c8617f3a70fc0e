"""What a relay holds."""

from __future__ import annotations

from fogft.cloud.local.relay import Relay


def held_bytes(relay: Relay) -> int:
    """Return how much it has received and not yet passed on."""
    return sum(pipe.held_bytes for pipes in relay.connections.values() for pipe in pipes)
