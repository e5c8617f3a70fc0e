"""A proxy in a process that need not import it: see `tests.link.forked`."""

from __future__ import annotations

import importlib
import json
import os
import sys

from fogft.cli.main import main as fogft
from fogft.process import load_numpy

load_numpy()
for name in (
    "fogft.link.zenoh.replica.listener",
    "fogft.link.zenoh.robot.dialer",
    "fogft.proxy.replica.process",
    "fogft.proxy.robot.process",
    "fogft.ros.messages",
    "fogft.ros.node",
):
    importlib.import_module(name)


def main() -> None:
    """Run the words that are given, in that environment and folder."""
    words, environ, folder = json.loads(sys.argv[1])
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    os.environ.clear()
    os.environ.update(environ)
    os.chdir(folder)
    sys.orig_argv = [sys.executable, "-m", "fogft", *words]  # by which it may start anew
    fogft(words)
