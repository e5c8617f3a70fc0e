"""How long a person waits for the command line."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from fogft import disk
from fogft.model.plain import to_plain
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import Identity, write_identity
from fogft.pool.manager.status import PoolStatus, ReplicaStatus, ServiceStatus
from tests.bench.caller import milliseconds
from tests.bench.rig import ROOT
from tests.estimates import median

_REPLICAS = 3


def commands(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Time `fogft --help`, `fogft status` of a pool with three replicas, and `import fogft`."""
    _pool(folder / "home")
    environ = {**os.environ, "FOGFT_HOME": str(folder / "home"), "PYTHONPATH": str(ROOT)}
    fogft = Path(sys.executable).with_name("fogft")
    start = [str(fogft)] if fogft.exists() else [sys.executable, "-m", "fogft"]
    asked = {
        "fogft --help": [*start, "--help"],
        "fogft status": [*start, "status"],
        "import fogft": [sys.executable, "-c", "import fogft"],
        "python, nothing else": [sys.executable, "-c", ""],
    }
    took: dict[str, list[float]] = {name: [] for name in asked}
    for number in range(1 + (5 if quick else 20)):
        for name, command in asked.items():
            began = time.perf_counter()
            subprocess.run(command, env=environ, cwd=folder, check=True, capture_output=True)
            if number:  # the first run fills the disk cache
                took[name].append(time.perf_counter() - began)
    return [
        {
            "command": name,
            "runs": len(sample),
            "median_ms": median(milliseconds(sample)),
            "longest_ms": max(milliseconds(sample)),
        }
        for name, sample in took.items()
    ]


def _pool(home: Path) -> None:
    """Write a pool as its manager leaves it on disk."""
    uid = "0" * 16
    paths = PoolPaths.of("bench", home)
    paths.folder.mkdir(parents=True)
    write_identity(paths, Identity("bench", uid, "local", "bench.yaml", time.time()))
    replicas = [
        ReplicaStatus(
            slot=slot, generation=1, phase="ready", verdict="good",
            location=f"local/region-{slot}/a", instance="process", spot=True, usd_per_hour=0.1,
            endpoint="127.0.0.1:7447", link="up", rtt_s=0.001, silent_for_s=0.0, won=100,
            in_flight=0, restarts=0, age_s=60.0, detail="",
        )
        for slot in range(_REPLICAS)
    ]  # fmt: skip
    seen = PoolStatus(
        pool="bench", uid=uid, cloud="local", file="bench.yaml", epoch=1, manager_pid=1,
        observed_at=time.time(), cloud_reachable=True, stopping=False, target=_REPLICAS,
        ready=_REPLICAS, uplink_suspected=False, usd_per_hour=0.3, proxy_pid=1, proxy_alive=True,
        replicas=replicas, services=[ServiceStatus("/flag", "std_srvs/srv/SetBool", _REPLICAS)],
    )  # fmt: skip
    disk.write_json(paths.status, to_plain(seen))
