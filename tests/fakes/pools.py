"""Pools on disk as a command finds them, without a process behind them."""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from fogft import disk
from fogft.model.intent import Intent
from fogft.model.plain import to_plain
from fogft.model.reason import Cause, Reason
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import Identity, write_identity
from fogft.pool.manager.status import PoolStatus, ReplicaStatus, ServiceStatus

UID = "0123456789abcdef"
FILE = "/home/robot/pool.yaml"
SPEC = """\
name: planner
run: python3 planner_service.py
fogft:
  replicas: 3
  services:
    - {name: /plan, type: nav_msgs/srv/GetPlan}
"""
REPLICA = ReplicaStatus(
    slot=0,
    generation=1,
    phase="ready",
    verdict="good",
    location="local/us-west-2/a",
    instance="small",
    spot=True,
    usd_per_hour=0.0214,
    endpoint="127.0.0.1:40001",
    link="up",
    rtt_s=0.00042,
    silent_for_s=0.0,
    won=1412,
    in_flight=2,
    restarts=0,
    age_s=421.0,
    detail="",
)
STATUS = PoolStatus(
    pool="planner",
    uid=UID,
    cloud="local",
    file=FILE,
    epoch=1,
    manager_pid=4711,
    observed_at=0.0,
    cloud_reachable=True,
    stopping=False,
    target=3,
    ready=1,
    uplink_suspected=False,
    usd_per_hour=0.0628,
    proxy_pid=4712,
    proxy_alive=True,
    notes=("waiting after 3 failed launches (capacity)",),
    replicas=(
        REPLICA,
        replace(
            REPLICA, slot=1, generation=12, phase="starting", link="connecting", rtt_s=None,
            location="local/eu-central-1/b", usd_per_hour=0.02, won=0, age_s=4.2,
            detail="`/plan` is not up yet",
        ),
        replace(
            REPLICA, slot=2, generation=3, phase="draining", link="suspect", rtt_s=1.25, won=7,
            age_s=93_600.0,
            detail="silent for 17 s, and so it is replaced by another one elsewhere",
            reason=Reason(Cause.SILENT, seconds=17.0),
        ),
    ),
    services=(
        ServiceStatus(
            name="/plan",
            type="nav_msgs/srv/GetPlan",
            ready_replicas=1,
            counters={
                "received": 1424, "answered": 1416, "fallback": 3, "late": 2801, "rejected": 0,
                "silent": 4, "empty": 0, "turned_away": 1, "refused": {}, "pending": 2,
                "pending_bytes": 300, "p50_s": 0.0213, "p99_s": 0.148,
            },
        ),
    ),
)  # fmt: skip


def report(paths: PoolPaths, status: PoolStatus = STATUS, *, age_s: float = 0.2) -> None:
    """Write what the client proxy would report of such a pool."""
    names = [service.name for service in status.services]
    links = [
        {
            "slot": one.slot, "generation": one.generation, "state": one.link,
            "ready": names if one.phase == "ready" and one.link == "up" else [],
            "heard_age_s": 0.1, "rtt_s": one.rtt_s, "won": one.won, "in_flight": one.in_flight,
        }
        for one in status.replicas if one.link
    ]  # fmt: skip
    written = {
        "pid": os.getpid(), "written_at": time.time() - age_s, "links": links,
        "services": {service.name: service.counters for service in status.services},
        "uplink_suspected": status.uplink_suspected,
        "robot": status.topology.get("robot", ""),
        "gateways": [{"generation": 1, **link} for link in status.topology.get("links", [])],
    }  # fmt: skip
    disk.write_json(paths.proxy_status, written)


@contextmanager
def alive(paths: PoolPaths) -> Iterator[None]:
    """Hold the locks of a manager and a client proxy, as long as these would live."""
    with disk.locked(paths.manager_lock), disk.locked(paths.proxy_lock):
        yield


@contextmanager
def reporting(paths: PoolPaths) -> Iterator[None]:
    """As `alive`, with ever new reports: a busy machine takes seconds to start a command."""
    enough = threading.Event()

    def report_on() -> None:
        while not enough.wait(0.1):
            disk.write_json(paths.status, to_plain(replace(STATUS, observed_at=time.time())))
            report(paths)

    with alive(paths), ThreadPoolExecutor(1) as threads:
        reports = threads.submit(report_on)
        try:
            yield
        finally:
            enough.set()
            reports.result()


def lay_down(
    home: Path,
    status: PoolStatus | None = STATUS,
    *,
    age_s: float = 0.4,
    file: str | Path = FILE,
    cloud: str = "local",
) -> PoolPaths:
    """Write a pool's files as `up` and a manager leave them."""
    name = status.pool if status else "planner"
    paths = PoolPaths.of(name, home)
    paths.folder.mkdir(parents=True)
    paths.spec.write_text(SPEC.replace("planner\n", f"{name}\n", 1))
    paths.intent.write_text(json.dumps(to_plain(Intent())))
    if status is not None:
        observed: dict[str, Any] = to_plain(replace(status, observed_at=time.time() - age_s))
        disk.write_json(paths.status, observed)
        report(paths, status)
    write_identity(paths, Identity(name, UID, cloud, str(file), time.time()))
    return paths
