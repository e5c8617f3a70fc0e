"""Reserve a ROS domain and a TCP port that no other machine on this computer uses.

A reservation is an abstract socket name: the kernel gives it to one process, of any user, and
takes it back when the process ends. Domains and ports that others use without a reservation
show in the ports that are bound.
"""

import contextlib
import os
import random
import socket
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from fogft.errors import RosError
from fogft.ros.spdp import domain_of

DOMAINS = range(1, 102)  # ports of higher domains are in Linux's ephemeral range
_LOW_DOMAINS = 60  # preferred: robots' and tests' own tend to be 0 or above these
LAST_DOMAIN = 232
PORTS = range(20_000, 32_000)  # below Linux's ephemeral ones


@dataclass
class Reservation:
    """A number that is ours until `release` or the end of the process."""

    number: int
    _socket: socket.socket

    def release(self) -> None:
        """Give the number back. Idempotent."""
        self._socket.close()


def own_domain(environ: Mapping[str, str] = os.environ, *, of_dds: bool = False) -> int:
    """Return the ROS domain that an environment names. Raises RosError: it names none."""
    text = environ.get("ROS_DOMAIN_ID") or "0"
    with contextlib.suppress(ValueError):
        number = int(text)
        if number >= 0 and not (of_dds and number > LAST_DOMAIN):
            return number
    hint = f"set it to a number from 0 to {DOMAINS[-1]}, the same in every terminal"
    raise RosError(f"`ROS_DOMAIN_ID={text}` is not a ROS domain", hint)


def reserve_domain(not_these: Iterable[int] = ()) -> Reservation | None:
    """Reserve a ROS domain id, not one of these, whose ports are unbound; None: none is left."""
    taken = set(not_these) | _domains_in_use()
    tried = sorted(DOMAINS, key=lambda domain: (domain >= _LOW_DOMAINS, random.random()))
    reserved = (_reserve("ros-domain", domain) for domain in tried if domain not in taken)
    return next(filter(None, reserved), None)


def reserve_port() -> Reservation | None:
    """Reserve a TCP port on which nobody listens; None if there is none left."""
    for port in random.sample(PORTS, len(PORTS)):
        reservation = _reserve("port", port)
        if reservation is not None:
            with contextlib.suppress(OSError):  # somebody listens there
                socket.create_server(("127.0.0.1", port)).close()
                return reservation
            reservation.release()
    return None


def _reserve(what: str, number: int) -> Reservation | None:
    name = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        name.bind(f"\0fogft-{what}-{number}")
    except OSError:
        name.close()
        return None
    return Reservation(number, name)


def _domains_in_use() -> set[int]:
    domains = set()
    for table in ("/proc/net/udp", "/proc/net/udp6"):
        with contextlib.suppress(OSError):
            for line in Path(table).read_text().splitlines()[1:]:
                port = int(line.split()[1].rpartition(":")[2], 16)
                domains.add(domain_of(port))
    return domains
