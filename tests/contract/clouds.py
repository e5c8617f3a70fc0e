"""What the contract of a cloud needs of an implementation, and how the mock gives it.

To put another cloud under the contract: write a maker like `mock_cloud` and add it to
`MAKERS`. The suite knows nothing of time but `wait_until`.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fogft.cloud.local import processes
from fogft.cloud.local.chaos import Chaos
from fogft.cloud.local.cloud import LocalCloud
from fogft.cloud.port import Cloud, Launch
from fogft.cloud.sky.naming import cluster_name
from fogft.errors import CloudUnreachable
from fogft.model.replica import Placement, ReplicaId
from tests.cloud.waiting import STAND_IN
from tests.fakes.cloud import MockCloud, zones
from tests.fakes.waiting import wait_for
from tests.sky.scene import Scene as SkyScene

# Not the same in every run: on the local cloud the uid marks real processes of this computer.
UID = secrets.token_hex(8)
OTHER_UID = secrets.token_hex(8)


@dataclass
class CloudUnderTest:
    """One implementation with the means to break it.

    Attributes:
        resources: What `offers` can meet, in at least two locations.
        impossible: What it can never meet.
        wait_until: Waits (by polling, or by advancing simulated time) until a predicate
            is true, and fails after a generous limit.
        fill: Leaves no capacity in a location; None where that cannot be done.
        preempt: Takes a machine away after a notice of some seconds (0: none).
        notices: Whether the cloud itself tells of a preemption notice; else the link does.
        outage: Makes the cloud unreachable (True) or reachable again (False).
        task, files: What an order needs here so that its machine runs.
    """

    cloud: Cloud
    resources: Mapping[str, Any]
    impossible: Mapping[str, Any]
    wait_until: Callable[[Callable[[], object]], None]
    fill: Callable[[str], None] | None = None
    preempt: Callable[[ReplicaId, float], None] | None = None
    outage: Callable[[bool], None] | None = None
    notices: bool = True
    task: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)

    def order(
        self, slot: int, generation: int = 1, *, at: Placement | None = None, uid: str = UID
    ) -> Launch:
        """Make an order for the first offer, or for a placement."""
        offers = self.cloud.offers(self.resources)
        offer = next(o for o in offers if at is None or o.placement == at)
        id = ReplicaId(uid, slot, generation)
        price = offer.usd_per_hour
        return Launch(
            id, "contract", offer.placement, price, "0" * 16, task=self.task, files=self.files
        )


class SimulatedTime:
    """A clock that moves only when something waits for it."""

    def __init__(self) -> None:
        self.now = 1_700_000_000.0

    def wait_until(self, predicate: Callable[[], object]) -> None:
        for _ in range(1000):
            if predicate():
                return
            self.now += 0.5
        raise AssertionError("waited 500 simulated seconds")


def mock_cloud(folder: Path) -> Iterator[CloudUnderTest]:
    """The mock cloud, in three zones."""
    time = SimulatedTime()
    cloud = MockCloud(lambda: time.now, zones("east/one/a", "east/two/a", "west/one/a"))

    def outage(on: bool) -> None:
        cloud.unreachable = on

    yield CloudUnderTest(
        cloud,
        resources={},
        impossible={"region": "atlantis"},
        wait_until=time.wait_until,
        fill=lambda location: setattr(cloud.zones[location], "capacity", 0),
        preempt=lambda id, notice_s: cloud.preempt(id, notice_s=notice_s),
        outage=outage,
    )


def local_cloud(folder: Path) -> Iterator[CloudUnderTest]:
    """The local cloud: real processes, with a stand-in for the server proxy."""
    cloud = LocalCloud(folder / "local", STAND_IN)
    chaos = Chaos(cloud.root)
    here, away = cloud.machines_folder, cloud.root / "away"

    def outage(on: bool) -> None:
        if on:
            here.rename(away)
            here.touch()  # not a folder: nothing can be told
        else:
            here.unlink()
            away.rename(here)

    try:
        yield CloudUnderTest(
            cloud,
            resources={"any_of": [{"infra": "local/us-west-1"}, {"infra": "local/us-west-2"}]},
            impossible={"infra": "local/atlantis"},
            wait_until=wait_for,
            fill=lambda location: chaos.capacity(location, 0),
            preempt=chaos.preempt,
            outage=outage,
            files={"replica.yaml": b"{}"},
        )
    finally:
        processes.end([*processes.find(pool_uid=UID), *processes.find(pool_uid=OTHER_UID)])


def sky_cloud(folder: Path) -> Iterator[CloudUnderTest]:
    """Real clouds, on a scripted SkyPilot whose launches take a moment."""
    scene = SkyScene(folder)
    scene.sky.boots = True

    def wait_until(predicate: Callable[[], object]) -> None:
        for _ in range(200):
            if predicate():
                return
            scene.work(rounds=1)
        raise AssertionError("waited 200 simulated seconds")

    def preempt(id: ReplicaId, notice_s: float) -> None:
        scene.sky.preempt(cluster_name(id))
        scene.cloud.refresh(id)  # as when its probes go unanswered

    def outage(on: bool) -> None:
        scene.sky.unreachable = on
        scene.provider.reachable = not on
        scene.pass_s(20)

    yield CloudUnderTest(
        scene.cloud,
        resources={"infra": "aws"},
        impossible={"region": "atlantis"},
        wait_until=wait_until,
        fill=scene.sky.full.add,
        preempt=preempt,
        notices=False,
        outage=outage,
        files={"replica.yaml": b"x: 1"},
    )


MAKERS: dict[str, Callable[[Path], Iterator[CloudUnderTest]]] = {
    "sky": sky_cloud,
    "local": local_cloud,
    "mock": mock_cloud,
}


if "EMULATED_AWS" in os.environ:  # inside a world of `scripts/test-sky --contract`
    from tests.sky.emulated_aws.under_contract import emulated

    MAKERS["emulated"] = lambda folder: emulated(folder, CloudUnderTest)


def is_unreachable(call: Callable[[], object]) -> bool:
    """Whether a call raises `CloudUnreachable`."""
    try:
        call()
    except CloudUnreachable:
        return True
    return False
