"""A full disk, no descriptors, a read-only disk, a folder that is gone: each process goes on.

Requests are answered all the time, the log says what is wrong, and files are written again when
the machine is well. One exception: a client proxy whose folder is gone ends, since so has its pool.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fogft.ros import environment
from tests.link.wire_pool import wait_for
from tests.needs import needs
from tests.proxy.breaking import FAULTS, small_disk
from tests.proxy.by_hand import Caller, Parts
from tests.proxy.gateway_pool import GatewayPool
from tests.records.rendezvous_pool import Rendezvous

pytestmark = [needs("namespaces"), pytest.mark.timeout(180)]  # mounting needs root, as they do
environment.prepare(os.environ)
LONG = 40  # requests, some 20 ms apart: each process has wanted to write several times


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "small") as made:
        yield made


def written_anew(*files: Path) -> None:
    """Wait until each file was written once more."""
    before = {file: file.stat().st_mtime_ns for file in files if file.exists()}
    wait_for(lambda: all(f.exists() and f.stat().st_mtime_ns != before.get(f) for f in files))


@pytest.mark.ros
def test_client_proxy_and_server_proxy_go_on(folder, ros_domains: Callable[[], int]):
    parts = Parts(folder, ros_domains)
    caller = None
    try:
        replica = parts.replica(0)
        robot = parts.robot("robot", replica)
        caller = Caller(robot.domain)
        caller.wait()
        for fault, breaks in FAULTS.items():
            log = os.open(folder / "robot.log", os.O_RDONLY)
            os.lseek(log, 0, os.SEEK_END)
            with breaks(folder, [replica.process.pid, robot.process.pid]):
                if fault == "removed":
                    assert robot.process.wait(60) == 0
                    assert b"folder_gone" in os.read(log, 1 << 20)
                else:
                    for _ in range(LONG):
                        caller.ask()
                        caller.spin(0.02)
                    assert caller.all_answered(), fault
                    written_anew(folder / "robot-status.json")
            os.close(log)
            if fault == "removed":
                robot.process = parts.start("proxy", robot.config)
            written_anew(folder / "robot-status.json")
            caller.wait()
            caller.ask(20)
            assert caller.all_answered(), fault
            assert replica.process.poll() is None, fault
    finally:
        if caller is not None:
            caller.close()
        parts.close()


def test_gateway_and_rendezvous_go_on(folder):
    pool = GatewayPool(folder)
    rendezvous = Rendezvous(pool.authority, "a")
    try:
        meeting = f"rendezvous: ['{rendezvous.endpoint}']\n"
        pool.replica(0)
        edge = pool.gateway("edge", extra=meeting + "records: edge-records.json\n")
        ada = pool.robot("ada")
        pool.lay_out({"edge": (edge.endpoint(), ())}, {"ada": ("edge",)})
        wait_for(lambda: ada.ready() and ada.tell()["report"]["gateways"])
        ada.ask(5)
        ada.all_right()
        for fault, breaks in FAULTS.items():
            assert rendezvous.process is not None
            log = os.open(folder / "edge.log", os.O_RDONLY)
            begins = os.lseek(log, 0, os.SEEK_END)
            with breaks(folder, [edge.process.pid, rendezvous.process.pid]):
                for _ in range(LONG):
                    ada.ask(1)
                    ada.all_right()
                if fault != "removed":
                    written_anew(folder / "edge-status.json")
                else:
                    wait_for(lambda: b"file_failed" in os.pread(log, 1 << 20, begins))  # noqa: B023
            os.close(log)
            written_anew(folder / "edge-status.json")
            (rendezvous.folder / "status.json").unlink()
            pool.robot(f"after-{fault}", extra=meeting)  # news, which the rendezvous writes down
            written_anew(rendezvous.folder / "status.json", rendezvous.folder / "records.json")
            ada.ask(20)
            ada.all_right()
            assert edge.process.poll() is None, fault
            assert rendezvous.alive(), fault
    finally:
        pool.close()
        rendezvous.kill()
