"""Makes replicas of a pool hostile: Python begins here where ``PYTHONPATH`` has this folder.

The server proxies in the folders of the machines that ``$FOGFT_HOSTILE_MACHINES`` names, such as
``0.1 0.2``, lie as `tests.hostile.serve` does; every other process is as it is.
"""

import os
import sys

if "serve" in sys.orig_argv and any(
    f"-{machine}/" in word
    for machine in os.environ.get("FOGFT_HOSTILE_MACHINES", "").split()
    for word in [*sys.orig_argv, os.getcwd()]
):
    from pathlib import Path

    from tests.hostile import serve

    serve.patch(serve.Hostile(Path(os.environ[serve.HOSTILE])))
