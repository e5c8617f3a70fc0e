"""A command of `fogft` in a process that need not import it: see `tests.link.forked`."""

from __future__ import annotations

import contextlib
import gc
import importlib
import io
import json
import os
import pkgutil
import sys

from fogft.cli.main import run

for package in ("fogft.cli", "fogft.cloud.local", "fogft.pool.commands"):
    for module in pkgutil.iter_modules(importlib.import_module(package).__path__, f"{package}."):
        with contextlib.suppress(ModuleNotFoundError):  # that of the real `ros2` command
            importlib.import_module(module.name)
with contextlib.redirect_stdout(io.StringIO()):
    run(["--version"])  # makes what every command needs
gc.freeze()


def main() -> None:
    """Run the words that are given, in that environment and folder."""
    words, environ, folder, out = json.loads(sys.argv[1])
    os.environ.clear()
    os.environ.update(environ)
    os.chdir(folder)
    with open(out, "wb") as file:
        os.dup2(file.fileno(), sys.stdout.fileno())
    code = run(words)
    sys.stdout.flush()
    os._exit(code)  # what it has imported need not be taken down
