"""Makes one replica of a pool hostile: Python begins here where ``PYTHONPATH`` has this folder.

The server proxy in the folder of the machine that ``$FOGFT_HOSTILE_MACHINE`` names, such as
``0.1``, lies as `tests.hostile.serve` does; every other process is as it is.
"""

import os
import sys

if "serve" in sys.orig_argv and any(
    f"-{os.environ.get('FOGFT_HOSTILE_MACHINE')}/" in word for word in [*sys.orig_argv, os.getcwd()]
):
    from pathlib import Path

    from tests.hostile import serve

    serve.patch(serve.Hostile(Path(os.environ[serve.HOSTILE])))
