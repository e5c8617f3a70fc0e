"""A cable between two network namespaces that delays, reorders and loses packets, by a seed.

Two TUN devices and a thread that carries packets from one to the other: it needs no kernel module
but that one, and the test may change how rough it is at any time.
"""

from __future__ import annotations

import contextlib
import fcntl
import heapq
import os
import random
import select
import struct
import subprocess
import threading
import time

from tests.link.namespaces import inside

_TUNSETIFF = 0x400454CA
_TUN, _WITHOUT_HEADER = 0x0001, 0x1000
_PACKET_BYTES = 65535
_QUEUE_LIMIT = 2000  # packets on their way in one direction; what comes beyond is lost


def _tun(where: str, name: str, address: str, far_address: str) -> int:
    with inside(where):
        device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        request = struct.pack("16sH22x", name.encode(), _TUN | _WITHOUT_HEADER)
        fcntl.ioctl(device, _TUNSETIFF, request)
    for words in (
        ("addr", "add", address, "peer", far_address, "dev", name),
        ("link", "set", name, "up"),
    ):
        subprocess.run(["ip", "-n", where, *words], check=True, capture_output=True)
    return device


class RoughCable:
    """Joins two namespaces until closed.

    Args:
        one: A namespace.
        address: Its address on this cable.
        other: Another namespace.
        far_address: That one's address.
        seed: Of what becomes of packets.

    Attributes:
        delay_s: Each packet takes so long.
        jitter_s: And up to so much longer, so that packets overtake each other.
        loss: This part of all packets is lost.
        lost: How many packets were lost.
    """

    def __init__(
        self,
        one: str,
        address: str,
        other: str,
        far_address: str,
        *,
        delay_s: float = 0.0,
        jitter_s: float = 0.0,
        loss: float = 0.0,
        seed: int = 1,
    ) -> None:
        self.delay_s, self.jitter_s, self.loss = delay_s, jitter_s, loss
        self.lost = 0
        self._chance = random.Random(seed)
        self._ends = (_tun(one, "rough0", address, far_address),
                      _tun(other, "rough1", far_address, address))  # fmt: skip
        self._on_the_way: list[tuple[float, int, int, bytes]] = []
        self._count = 0
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        other = dict(zip(self._ends, reversed(self._ends), strict=True))
        while not self._closed.is_set():
            due = self._on_the_way[0][0] - time.monotonic() if self._on_the_way else 0.1
            readable, _, _ = select.select(self._ends, (), (), min(0.1, max(0.0, due)))
            for end in readable:
                with contextlib.suppress(BlockingIOError):
                    while True:
                        self._take(os.read(end, _PACKET_BYTES), other[end])
            while self._on_the_way and self._on_the_way[0][0] <= time.monotonic():
                _, _, to, packet = heapq.heappop(self._on_the_way)
                with contextlib.suppress(OSError):  # an end that takes nothing now loses it
                    os.write(to, packet)

    def _take(self, packet: bytes, to: int) -> None:
        if self._chance.random() < self.loss or len(self._on_the_way) >= _QUEUE_LIMIT:
            self.lost += 1
            return
        self._count += 1
        at = time.monotonic() + self.delay_s + self._chance.uniform(0.0, self.jitter_s)
        heapq.heappush(self._on_the_way, (at, self._count, to, packet))

    def close(self) -> None:
        self._closed.set()
        self._thread.join(10.0)
        for end in self._ends:
            os.close(end)
