"""Launch one machine and be killed, or meet a full disk, at a given step.

``launcher.py ROOT UID SLOT REGION/ZONE STEP``. Steps: ``write`` (before the folder is renamed
into place), ``rename`` (after that), ``spawn`` (right before the process), ``spawned`` (right
after), ``done`` (launch has returned), ``full`` (no file can be written), ``none``.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

from fogft.cloud.local.cloud import LocalCloud
from fogft.cloud.port import Launch
from fogft.errors import CloudError
from fogft.model.replica import Placement, ReplicaId
from tests.cloud.waiting import STAND_IN

root, uid, slot, where, step = sys.argv[1:]


def die(*_: object, **__: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def after(function):
    def called(*args, **options):
        result = function(*args, **options)
        die()
        return result

    return called


rename, popen = Path.rename, subprocess.Popen
if step == "write":
    Path.rename = die
elif step == "rename":
    Path.rename = after(rename)
elif step == "spawn":
    subprocess.Popen = die
elif step == "spawned":
    subprocess.Popen = after(popen)
elif step == "full":
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, resource.RLIM_INFINITY))

region, zone = where.split("/")
placement = Placement("local", region, zone, "cpu4")
order = Launch(
    ReplicaId(uid, int(slot), 1), "test", placement, 0.07, "abc",
    files={"replica.yaml": b"{}" + b" " * 100},
)  # fmt: skip
try:
    LocalCloud(Path(root), STAND_IN).launch(order)
except CloudError as error:
    sys.exit(f"{type(error).__name__}: {error.message}")
if step == "done":
    die()
