"""Ports for servers that are to listen later, or again at the same place."""

from __future__ import annotations

import random
import socket
from collections import deque

# Below those that Linux gives to whoever asks for any: nobody else is given one meanwhile.
_PORTS = range(12_000, 22_000)
# Names that only one process at a time can have keep off others until a port is used.
_kept: deque[socket.socket] = deque(maxlen=50)


def free_port(host: str = "127.0.0.1") -> int:
    """Return a TCP port that nobody has."""
    while True:
        port = random.SystemRandom().choice(_PORTS)
        keep = socket.socket(socket.AF_UNIX)
        with socket.socket() as tried:
            try:
                keep.bind(f"\0fogft-test-port-{port}")
                tried.bind((host, port))
            except OSError:
                keep.close()
                continue
        if len(_kept) == _kept.maxlen:
            _kept[0].close()
        _kept.append(keep)
        return port


def free_ports(count: int) -> list[int]:
    """Return so many, each another."""
    ports: set[int] = set()
    while len(ports) < count:
        ports.add(free_port())
    return list(ports)
