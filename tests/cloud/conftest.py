"""A local cloud in a temporary folder, with a stand-in for the server proxy."""

from __future__ import annotations

import json
import secrets
import shutil
from pathlib import Path

import pytest

from fogft.cloud.local import processes
from fogft.cloud.local.chaos import Chaos
from fogft.cloud.local.cloud import LocalCloud
from fogft.cloud.port import Launch
from fogft.model.replica import Machine, MachinePhase, Placement, ReplicaId
from tests.cloud.waiting import STAND_IN
from tests.fakes.waiting import wait_for

REGIONS = """
boot_s: 0.01
regions:
  us-west-1: {zones: [a, b]}
  us-west-2: {zones: {a: {capacity: 2}}}
  slow-1: {zones: [a], boot_s: 3600}
"""


class Local:
    """A local cloud, and shorthands for what tests do with it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.uid = secrets.token_hex(8)
        self.cloud = LocalCloud(root, STAND_IN)
        self.chaos = Chaos(root)
        root.mkdir()
        (root / "regions.yaml").write_text(REGIONS)

    def order(
        self,
        slot: int = 0,
        generation: int = 1,
        where: str = "us-west-1/a",
        task: dict | None = None,
        **config: object,
    ) -> Launch:
        """Make an order; `config` goes to the stand-in."""
        region, zone = where.split("/")
        return Launch(
            id=ReplicaId(self.uid, slot, generation),
            pool="test",
            placement=Placement("local", region, zone, "cpu4"),
            usd_per_hour=0.07,
            spec_hash="abc",
            task=task or {},
            files={"replica.yaml": json.dumps(config).encode(), "replica.key": b"secret"},
        )

    def launch(self, slot: int = 0, **more) -> ReplicaId:
        """Launch a machine; return its id at once."""
        order = self.order(slot, **more)
        self.cloud.launch(order)
        return order.id

    def running(self, slot: int = 0, **more) -> Machine:
        """Launch a machine and wait until it runs."""
        id = self.launch(slot, **more)
        return self.wait(id, MachinePhase.RUNNING)

    def machine(self, id: ReplicaId) -> Machine | None:
        """Return a machine as listed."""
        return next((m for m in self.cloud.machines(id.pool_uid) if m.id == id), None)

    def wait(self, id: ReplicaId, phase: MachinePhase) -> Machine:
        """Wait until a machine is in a phase."""
        return wait_for(lambda: (m := self.machine(id)) and m.phase is phase and m)

    def wait_gone(self, id: ReplicaId) -> None:
        """Wait until a machine is no longer listed, and nothing of it runs."""
        wait_for(lambda: self.machine(id) is None)
        wait_for(lambda: not processes.find(machine=str(id)))

    def folder(self, id: ReplicaId) -> Path:
        """Return a machine's folder."""
        return self.root / "machines" / str(id)

    def given(self, id: ReplicaId) -> dict:
        """Return what the stand-in was started with, once it was."""
        path = self.folder(id) / "given.json"
        return json.loads(wait_for(lambda: path.exists() and path.read_text()))


@pytest.fixture
def local(tmp_path):
    made = Local(tmp_path / "local")
    yield made
    shutil.rmtree(
        made.root, ignore_errors=True
    )  # what is only starting is not found yet: it ends without its folder
    processes.end(processes.find(pool_uid=made.uid))
