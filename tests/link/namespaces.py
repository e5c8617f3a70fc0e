"""Network namespaces of a test's own: made by it, joined by it, gone with it."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

_CLONE_NEWNET = 0x40000000
_ETHERNET_HEADER_BYTES = 14
_libc = ctypes.CDLL(None, use_errno=True)


def _run(*words: str) -> None:
    subprocess.run(words, check=True, capture_output=True, text=True)


@functools.cache
def can_make_namespaces() -> bool:
    """Try whether a network namespace can be made here: that takes root and `ip`."""
    name = f"fogft-try-{os.getpid()}"
    try:
        _run("ip", "netns", "add", name)
        _run("ip", "netns", "del", name)
    except (OSError, subprocess.CalledProcessError):
        return False
    return True


class Namespaces:
    """A few namespaces, joined by pairs of virtual cables."""

    def __init__(self) -> None:
        self._names: list[str] = []
        self._cables = 0

    def add(self, short: str) -> str:
        name = f"fogft-{short}-{os.getpid()}"
        _run("ip", "netns", "add", name)
        self._names.append(name)
        _run("ip", "-n", name, "link", "set", "lo", "up")
        return name

    def join(self, one: str, address: str, other: str, far_address: str) -> tuple[str, str]:
        """Lay a cable; both addresses lie in one /24. Return the names of its two ends."""
        self._cables += 1
        near, far = f"ft{self._cables}a", f"ft{self._cables}b"
        _run("ip", "-n", one, "link", "add", near, "type", "veth", "peer", "name", far,
             "netns", other)  # fmt: skip
        for name, cable, where in ((one, near, address), (other, far, far_address)):
            _run("ip", "-n", name, "addr", "add", f"{where}/24", "dev", cable)
            _run("ip", "-n", name, "link", "set", cable, "up")
        return near, far

    def blackhole(self, where: str, address: str) -> None:
        """Let nothing that `where` sends reach an address; nobody is told."""
        _run("ip", "-n", where, "route", "add", "blackhole", f"{address}/32")

    def restore(self, where: str, address: str) -> None:
        _run("ip", "-n", where, "route", "del", "blackhole", f"{address}/32")

    def readdress(self, where: str, cable: str, old: str, new: str) -> None:
        _run("ip", "-n", where, "addr", "del", f"{old}/24", "dev", cable)
        _run("ip", "-n", where, "addr", "add", f"{new}/24", "dev", cable)

    def remove(self, where: str, cable: str) -> None:
        """Take an interface away, as when a modem is pulled out."""
        _run("ip", "-n", where, "link", "del", cable)

    def address(self, where: str, address: str) -> None:
        """Give a machine an address of its own, whatever cable is used."""
        _run("ip", "-n", where, "addr", "add", f"{address}/32", "dev", "lo")

    def route(self, where: str, to: str, via: str, cable: str, *, metric: int) -> None:
        _run("ip", "-n", where, "route", "add", f"{to}/32", "via", via, "dev", cable,
             "metric", str(metric))  # fmt: skip

    def limit(self, where: str, cable: str, mbit_per_s: float, *, latency_ms: int = 400) -> None:
        """Have a cable carry no more; what would wait longer than `latency_ms` is lost."""
        _run(
            *("ip", "netns", "exec", where, "tc", "qdisc", "replace", "dev", cable, "root"),
            *("tbf", "rate", f"{mbit_per_s}mbit", "burst", "16kb", "latency", f"{latency_ms}ms"),
        )

    def by_packets(self, where: str, cable: str) -> None:
        """Have packets leave one by one, as on a real cable, so that their headers are counted."""
        _run("ip", "-n", where, "link", "set", "dev", cable, "gso_max_segs", "1")

    def forward(self, where: str) -> None:
        """Have a namespace pass on what is not for itself."""
        with inside(where):
            Path("/proc/sys/net/ipv4/ip_forward").write_text("1")

    def sent_bytes(self, where: str, cable: str) -> int:
        """Return how many bytes of IP have left on a cable, the headers of IP and TCP included."""
        shown = subprocess.run(
            ["ip", "-n", where, "-s", "-j", "link", "show", cable],
            check=True, capture_output=True, text=True,
        )  # fmt: skip
        sent = json.loads(shown.stdout)[0]["stats64"]["tx"]
        return int(sent["bytes"]) - _ETHERNET_HEADER_BYTES * int(sent["packets"])

    def close(self) -> None:
        for name in self._names:
            _run("ip", "netns", "del", name)


@contextlib.contextmanager
def inside(name: str) -> Iterator[None]:
    """Have this thread make its sockets in a namespace, and what it starts live there."""
    with open("/proc/thread-self/ns/net") as own, open(f"/var/run/netns/{name}") as there:
        _enter(there.fileno())
        try:
            yield
        finally:
            _enter(own.fileno())


def _enter(descriptor: int) -> None:
    if _libc.setns(descriptor, _CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), "setns")
