"""Every file of the state folder, damaged, as commands and a manager find it.

Whoever restores a backup, edits by hand or meets another version of fogft has such a file. What
reads it says what is wrong with which file, or does without it; a trace is a finding.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

from fogft import disk
from fogft.cli import main
from fogft.cloud.local import faults
from fogft.cloud.sky.journal import Entry, Journal
from fogft.cloud.sky.wheel import LockFolder, Locks
from fogft.errors import FogftError
from fogft.model.credentials import Role
from fogft.model.membership import to_dict
from fogft.model.plain import to_plain
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Member, Membership, Placement, ReplicaId
from fogft.planning.observed.history import Event, EventKind
from fogft.planning.observed.services import Discovered
from fogft.planning.rollout import Trial
from fogft.pool.commands import status
from fogft.pool.commands.composition import make_store
from fogft.pool.credentials import authority, claiming
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.lease import Lease
from fogft.pool.folder.paths import PoolPaths, latency_file
from fogft.pool.manager.distances import Latencies
from fogft.pool.manager.status import EventStatus
from fogft.records import cache as records_cache
from fogft.simulation import traces
from tests.fakes.pools import STATUS, UID, lay_down
from tests.fuzz.targets import Target, signed_records

NAME = STATUS.pool
ID = ReplicaId(UID, 0, 1)
PLACE = Placement("local", "us-west-2", "a", "cpu4")
CLAIM = "1"


def _lay_down(home: Path) -> PoolPaths:
    now = time.time()
    happened = EventStatus(now, "launched", "0.1", PLACE.location, "why")
    edge = {"name": "edge", "endpoint": "h:1", "through": (), "generations": (1,)}
    link = {"name": "edge", "generation": 1, "state": "up", "rtt_s": 0.1, "detail": "why"}
    drawn = {"robot": "ada", "gateways": [edge], "robots": {}, "through": ["edge"], "links": [link]}
    paths = lay_down(home, replace(STATUS, events=(happened,), topology=drawn))
    disk.write_json(paths.trial, to_plain(Trial()))
    members = Membership(NAME, UID, 1, 1, (Member(ID, "h:1"),))
    disk.write_json(paths.membership, to_dict(members))
    disk.write_json(paths.lease, {"epoch": 1, "beat": 3})
    disk.write_json(paths.discovered, to_plain(Discovered("0" * 16, {"/a": "a/srv/B"})))
    events = [
        Event(now, EventKind.LAUNCH, 0, 1, PLACE.location),
        Event(now, EventKind.GONE, 0, 1, reason=Reason(Cause.TIMEOUT, seconds=3.0)),
    ]
    paths.history.write_text("".join(json.dumps(to_plain(one)) + "\n" for one in events))
    authority.create_authority(paths.credentials, UID)
    ledger = Ledger(paths.credentials)
    holder, _ = ledger.issue_next(Role.ROBOT, "ada", UID)
    ledger.revoke([holder])
    ledger.issue_next(Role.REPLICA, "2000", UID)
    records_cache.write(paths.records, signed_records())
    return paths


def _pool(paths: PoolPaths) -> None:
    """Read all of a pool as a manager does, and as commands do that need none."""
    store = make_store(NAME)
    reads: list[Callable[[], object]] = [
        store.identity,
        store.spec,
        store.good,
        store.intent,
        store.membership,
        lambda: Lease(paths).release(),
        lambda: records_cache.read(paths.records),
        lambda: Ledger(paths.credentials).by_hand(),
        lambda: Ledger(paths.credentials).gateways(),
        lambda: status.read(paths, time.time()),
    ]
    for read in reads:
        with contextlib.suppress(FogftError):
            read()
    into = str(paths.folder / "report.html")
    for words in (["status", NAME], ["status", NAME, "--json"], ["events", NAME], ["list"],
                  ["credentials", "list", "--pool", NAME], ["cost", NAME, "--json"],
                  ["report", NAME, "--into", into]):  # fmt: skip
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            assert main.run(words) in (0, 1)


@cache
def read_by() -> Mapping[str, tuple[Path, bytes, Callable[[], object]]]:
    """Return each file with its good content, and what reads it."""
    home = Path(tempfile.mkdtemp(prefix="fogft-fuzz-state-"))
    atexit.register(shutil.rmtree, home, ignore_errors=True)
    os.environ["FOGFT_HOME"] = str(home)
    paths = _lay_down(home)
    found = {
        path.name: (path, path.read_bytes(), lambda: _pool(paths))
        for path in (*paths.folder.iterdir(), paths.credentials / "issued.json")
        if path.is_file() and path.suffix in (".json", ".jsonl", ".yaml")
    }

    def add(path: Path, read: Callable[[], object]) -> None:
        found[path.name] = path, path.read_bytes(), read

    disk.write_json(latency_file(), {"aws/us-west-2": {"rtt_s": 0.02, "as_of": time.time()}})
    latencies = Latencies(latency_file())
    add(latency_file(), lambda: latencies.stale(["aws/us-west-2"]))
    claims = home / "claims.json"
    claiming.own_token(claims, CLAIM, time.time())
    add(claims, lambda: claiming.own_token(claims, CLAIM, time.time()))
    local = home / "local"
    disk.make_folder(local)
    faults.write(local / faults.FILE, faults.CloudFaults({"local/a/b": 1.0}, {"local/a/b": 1}))
    add(local / faults.FILE, lambda: faults.read_cloud(local).out(time.time()))
    journal = Journal(home / "sky")
    journal.open(Entry(ID, PLACE, 0.1, "0" * 16, time.time()), {})
    (entry,) = (home / "sky").glob("*.json")
    found["journal of SkyPilot"] = entry, entry.read_bytes(), journal.entries
    locks = LockFolder(home / "locks", lambda wheel: Locks({"requirements.txt": "rich==1"}))
    locks.of("generation", home)
    (lock,) = (home / "locks").glob("*.json")
    found["lock of VMs"] = lock, lock.read_bytes(), lambda: locks.of("generation", home)
    spot = home / "traces"
    disk.make_folder(spot)
    zone = spot / "us-west-2b.json"
    value = {"metadata": {"gap_seconds": 300}, "data": [1, 0, 2], "times": [0, 300, 600]}
    disk.write_json(zone, value)
    found["trace"] = zone, zone.read_bytes(), lambda: traces.read(spot)
    return found


def state_files() -> dict[str, Target]:
    """Return what reads each file, by the file's name. Sets ``FOGFT_HOME``."""

    def decode(path: Path, read: Callable[[], object], good: bytes, data: bytes) -> object:
        path.write_bytes(data)
        try:
            return read()
        finally:
            path.write_bytes(good)

    return {
        name: Target(
            lambda data, path=path, read=read, good=good: decode(path, read, good, data),
            (FogftError,),
            (good,),
        )
        for name, (path, good, read) in read_by().items()
    }
