"""A Zenoh router in a process of its own, as `rmw_zenohd` is on a machine of `rmw_zenoh`."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass

from fogft.rmw_zenoh.node import OVERRIDE
from tests.ports import free_port

_PROGRAM = """
import sys, zenoh
from fogft.link.zenoh.settings import to_zenoh
session = zenoh.open(to_zenoh({
    "mode": "router", "listen/endpoints": [sys.argv[1]], "scouting/multicast/enabled": False,
    "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
    "transport/shared_memory/enabled": False,  # killed, it would leave a file in /dev/shm
}))
print("ready", flush=True)
sys.stdin.read()
"""


@dataclass
class Router:
    """The router of one machine.

    Attributes:
        endpoint: Where it listens.
    """

    endpoint: str
    process: subprocess.Popen[str] | None = None

    @property
    def environ(self) -> dict[str, str]:
        """What nodes need in their environment to find it, and nobody else."""
        here = f'connect/endpoints=["{self.endpoint}"]', 'listen/endpoints=["tcp/127.0.0.1:0"]'
        return {OVERRIDE: ";".join(here)}

    def start(self) -> None:
        """Start it, and wait until it listens."""
        self.process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, self.endpoint],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "ready\n"

    def kill(self) -> None:
        """Kill it."""
        if self.process is not None:
            self.process.kill()
            self.process.communicate()


@contextlib.contextmanager
def running() -> Iterator[Router]:
    """A router that runs, on a port that was free."""
    router = Router(f"tcp/127.0.0.1:{free_port()}")
    router.start()
    yield router
    router.kill()
