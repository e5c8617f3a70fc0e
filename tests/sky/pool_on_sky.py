"""A whole pool on the scripted SkyPilot: the manager's reconciler, its memory and its links."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from fogft.cloud.sky.naming import cluster_name
from fogft.cloud.sky.sdk import ClusterState
from fogft.model.replica import LinkReport, LinkState, Offer, Placement, ReplicaId
from fogft.model.spec import PoolSpec, ServiceSpec
from fogft.planning.observed.clock_jumps import Reading
from fogft.pool.folder.store import Identity
from fogft.pool.manager.reconciler import Reconciler, Tick
from fogft.reason_words import words
from tests.fakes.sky import EAST, WEST, replica
from tests.simulation.memory_store import MemoryStore
from tests.sky.scene import Scene

UID = replica().pool_uid
SERVICE = ServiceSpec("/plan", "nav_msgs/srv/GetPlan")
NORTH = Placement("aws", "eu-west-1", "eu-west-1a", "m6i.large")
PRICES = {EAST: 0.02, WEST: 0.03, NORTH: 0.04}


class PoolOnSky:
    """One pool. `tick` lets the manager work once, and a second pass.

    Attributes:
        boots: Whether launches succeed by themselves; else the test says how they end.
        leaving: Replicas that say that their machines will be taken.
        late: Replicas whose links are up, and for how many seconds a probe waits for its answer.
    """

    def __init__(self, folder: Path, *, replicas: int = 1, **spec: Any) -> None:
        self.scene = Scene(folder)
        self.scene.sky.boots = True
        self.scene.sky.sold = [Offer(place, price, "catalogue") for place, price in PRICES.items()]
        task = {"run": "serve", "resources": {"infra": "aws"}}
        self.spec = PoolSpec("perception", (SERVICE,), replicas=replicas, task=task, **spec)
        identity = Identity("perception", UID, "sky", "/pool.yaml", self.scene.now)
        self.store = MemoryStore(identity, self.spec)
        self.leaving: set[ReplicaId] = set()
        self.late: dict[ReplicaId, float] = {}
        self.serves: Callable[[str], bool] = lambda cluster: True  # by the cluster's name
        self.last: Tick | None = None
        self.manager = self._new_manager(1)

    @property
    def sky(self) -> Any:
        return self.scene.sky

    def _new_manager(self, epoch: int) -> Reconciler:
        return Reconciler(
            self.scene.cloud,
            self.store,
            clock=lambda: Reading(*[self.scene.now] * 3),
            links=self.links,
            epoch=epoch,
        )

    def kill_the_manager(self) -> None:
        """Nothing of the process is left; the next one knows only what is on disk."""
        self.scene.pending_work.clear()
        self.scene.repeated_work.clear()
        self.scene.cloud = self.scene.another_process()
        self.store.reopen()
        self.manager = self._new_manager(2)

    def links(self, pool_uid: str, now: float) -> tuple[LinkReport, ...]:
        """Report as the client proxy does: a machine that runs answers."""
        members = self.store.published.members if self.store.published else ()
        return tuple(self._link(member.id) for member in members)

    def _link(self, id: ReplicaId) -> LinkReport:
        if id in self.late:
            return LinkReport(
                id, LinkState.UP, frozenset({SERVICE.name}), silent_for_s=self.late[id], rtt_s=0.05
            )
        cluster = self.sky.records.get(cluster_name(id))
        runs = any(i.id == id for i in self.scene.provider.found.values())
        if not runs or cluster is None or cluster.state is not ClusterState.UP:
            return LinkReport(id, LinkState.CONNECTING)
        ready = frozenset({SERVICE.name}) if self.serves(cluster.name) else frozenset[str]()
        return LinkReport(id, LinkState.UP, ready, leaving=id in self.leaving)

    def tick(self, count: int = 1, seconds: float = 1.0) -> Tick:
        """Let the manager work, its threads too, and time pass; return the last tick."""
        for _ in range(count):
            self.last = self.manager.tick()
            self.scene.work(rounds=1)
            self.scene.pass_s(seconds - 1.0)
        assert self.last is not None
        return self.last

    def until(self, condition: Callable[[], Any], limit: int = 400, seconds: float = 1.0) -> Any:
        """Tick until a condition holds; return what it gave."""
        for _ in range(limit):
            self.tick(seconds=seconds)
            if value := condition():
                return value
        raise AssertionError((self.notes, self.ready(), self.sky.calls[-10:]))

    @property
    def notes(self) -> str:
        """What `fogft status` says."""
        return " | ".join(map(words, self.last.plan.notes)) if self.last else ""

    def ready(self) -> list[str]:
        """Return the replicas that answer."""
        health = self.last.plan.health if self.last else None
        return [j.id.short for j in health.replicas if j.serving] if health else []

    def ordered(self) -> list[str]:
        """Return where launches went, in order."""
        return [one.task["resources"]["infra"] for one in self.sky.launched]

    def running(self) -> list[str]:
        """Return what costs money now, by the provider's own list."""
        return sorted(i.id.short for i in self.scene.provider.found.values())

    def said(self) -> str:
        """Return what the history tells of failures."""
        return "\n".join(words(event.reason) for event in self.store.events)

    def change(self, **spec: Any) -> None:
        """Apply a changed file."""
        self.store.the_spec = replace(self.store.the_spec, **spec)
