"""Ports for servers that are to listen later, or again at the same place."""

from __future__ import annotations

import random
import socket

# Below those that Linux gives to whoever asks for any: nobody else is given one meanwhile.
_PORTS = range(12_000, 22_000)


def free_port(host: str = "127.0.0.1") -> int:
    """Return a TCP port that nobody has."""
    while True:
        port = random.SystemRandom().choice(_PORTS)
        with socket.socket() as tried:
            try:
                tried.bind((host, port))
            except OSError:
                continue
            return port


def free_ports(count: int) -> list[int]:
    """Return so many, each another."""
    ports: set[int] = set()
    while len(ports) < count:
        ports.add(free_port())
    return list(ports)
