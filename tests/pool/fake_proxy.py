"""Stands in for the client proxy: holds its lock and reports every member as ready."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

from fogft import __version__, disk
from fogft.model import membership
from fogft.pool.folder.paths import PoolPaths


def main(folder: str) -> None:
    paths = PoolPaths(Path(folder))
    lock = disk.Lock(paths.proxy_lock)
    if not lock.acquire(wait=False):
        sys.exit(1)
    while paths.folder.exists():
        raw = disk.read_json(paths.membership)
        members = membership.from_dict(raw).members if raw is not None else ()
        left_alone = paths.folder / "draining"  # what these replicas would say of themselves
        draining = left_alone.read_text().split() if left_alone.exists() else []
        links = [
            {
                "slot": m.id.slot,
                "generation": m.id.generation,
                "state": "up",
                "ready": ["/plan"],
                "leaving": m.id.short in draining,
                "draining": m.draining or m.id.short in draining,
            }
            for m in members
        ]
        report = {"pid": os.getpid(), "written_at": time.time(), "links": links, "services": {}}
        version = paths.folder / "version"
        report["version"] = version.read_text() if version.exists() else __version__
        heard = paths.folder / "heard"
        report["manager_epoch"] = int(heard.read_text()) if heard.exists() else 0
        partial = paths.folder / ".proxy-status"
        try:
            partial.write_text(json.dumps(report))
            partial.rename(paths.proxy_status)
        except FileNotFoundError:
            return
        time.sleep(0.1)


if __name__ == "__main__":
    main(sys.argv[1])
