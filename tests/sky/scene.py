"""A `SkyCloud` on the scripted SkyPilot, under a clock and threads that the test moves."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from fogft.cloud.port import Launch
from fogft.cloud.sky.adapter import SkyCloud
from fogft.cloud.sky.naming import cluster_name
from fogft.cloud.sky.wheel import Locks
from fogft.model.replica import Machine, Placement, ReplicaId
from tests.fakes.sky import EAST, ScriptedProvider, ScriptedSky, replica

TASK: Mapping[str, Any] = {"run": "python3 serve.py", "resources": {"infra": "aws", "cpus": "2+"}}


class Scene:
    """Time stands still until `pass_s`; other threads run only in `work`."""

    def __init__(self, folder: Path, *, with_provider: bool = True) -> None:
        self.folder = folder
        self.now = 1000.0
        self.set_s = 0.0  # by so much the clock was set
        self.provider = ScriptedProvider()
        self.sky = ScriptedSky(self.provider)
        self._with_provider = with_provider
        self.pending_work: list[Callable[[], None]] = []
        self.repeated_work: list[Callable[[], bool]] = []
        self.make_lock: Callable[[Path], Locks] = lambda wheel: Locks({})
        self.cloud = self.another_process()

    def another_process(self) -> SkyCloud:
        """Return an adapter that knows only what is on disk and in the cloud."""
        return SkyCloud(
            self.folder / "state",
            self.sky,
            [self.provider] if self._with_provider else [],
            owner="ann@robot",
            clock=lambda: self.now + self.set_s,
            steady=lambda: self.now,
            submit=lambda run: self.pending_work.append(run),
            repeat=lambda step: self.repeated_work.append(step),
            sleep=self.pass_s,
            make_wheel=lambda folder: folder,
            make_lock=self.make_lock,
        )

    def pass_s(self, seconds: float) -> None:
        self.now += seconds

    def order(self, id: ReplicaId | None = None, place: Placement = EAST, **changes: Any) -> Launch:
        fields: dict[str, Any] = {
            "id": id or replica(),
            "pool": "perception",
            "placement": place,
            "usd_per_hour": 0.021,
            "spec_hash": "abcd",
            "task": TASK,
            "files": {"replica.yaml": b"x: 1\n", "replica.key": b"secret"},
        }
        return Launch(**{**fields, **changes})

    def launched(self, id: ReplicaId | None = None, place: Placement = EAST) -> str:
        """Launch a replica until it runs; return its cluster's name."""
        id = id or replica()
        self.cloud.launch(self.order(id, place))
        self.sky.finish(cluster_name(id))
        self.work()
        assert self.machine(id).phase.value == "running"
        return cluster_name(id)

    def work(self, rounds: int = 12) -> None:
        """Let the other threads do what they can do now; a second passes each round."""
        for _ in range(rounds):
            pending, self.pending_work = self.pending_work, []
            for run in pending:
                run()
            self.repeated_work = [step for step in self.repeated_work if step()]
            self.pass_s(1.0)

    def machines(self, cloud: SkyCloud | None = None) -> list[Machine]:
        return list((cloud or self.cloud).machines(replica().pool_uid))

    def machine(self, id: ReplicaId | None = None) -> Machine:
        return next(m for m in self.machines() if m.id == (id or replica()))
