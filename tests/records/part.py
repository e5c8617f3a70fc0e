"""A rendezvous or a gateway in a process that need not import it: see `tests.link.forked`."""

from __future__ import annotations

import importlib
import os
import sys

from fogft.cli.main import main as fogft

for name in (
    "fogft.link.zenoh.replica.listener",
    "fogft.link.zenoh.robot.dialer",
    "fogft.pool.commands.rendezvous",
    "fogft.proxy.gateway.process",
):
    importlib.import_module(name)


def main() -> None:
    """Run the words that are given."""
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    fogft(sys.argv[1:])


if __name__ == "__main__":
    main()
