#!/usr/bin/python3
"""runc, asked for no more than this machine may give away.

SkyPilot starts containers with a million open files and CAP_SYS_RESOURCE. Where the tests run, root
itself may not have them; then a container gets what root has, and is a real one otherwise.
"""

import json
import os
import resource
import sys
from pathlib import Path

RUNC = "/usr/sbin/runc"


def humble(process: dict) -> None:
    """Take away what cannot be given."""
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    for limit in process.get("rlimits") or []:
        if limit["type"] == "RLIMIT_NOFILE":
            limit["hard"], limit["soft"] = min(limit["hard"], most), min(limit["soft"], most)
    capabilities = process.get("capabilities") or {}
    for kind, names in capabilities.items():
        capabilities[kind] = [name for name in names or [] if name != "CAP_SYS_RESOURCE"]


def main(words: list) -> None:
    if "create" in words and "--bundle" in words:
        path = Path(words[words.index("--bundle") + 1], "config.json")
        config = json.loads(path.read_text())
        humble(config["process"])
        path.write_text(json.dumps(config))
    elif "exec" in words and "--process" in words:
        path = Path(words[words.index("--process") + 1])
        process = json.loads(path.read_text())
        humble(process)
        path.write_text(json.dumps(process))
    os.execv(RUNC, [RUNC, *words])


if __name__ == "__main__":
    main(sys.argv[1:])
