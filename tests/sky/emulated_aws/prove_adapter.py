"""The adapter against unmodified SkyPilot on the emulated AWS: every launch, loss and end is real.

Runs inside a world (`world.sh`). The server proxy's place is taken by a plain web server, after
fogft's own set-up has run on the VM: what is proved here is the cloud, not the wire.
Prints a table of steps and writes it to the folder $RESULTS; ends with status 1 at the first
thing wrong.
"""

from __future__ import annotations

import subprocess
import sys
import urllib.error
import urllib.parse
import urllib.request
from dataclasses import replace
from pathlib import Path
from typing import Any

from fogft.cloud.port import Launch
from fogft.cloud.sky.adapter import SkyCloud
from fogft.errors import CloudUnreachable
from fogft.model.reason import Cause
from fogft.model.replica import Machine, MachinePhase, Offer, ReplicaId
from tests.sky.emulated_aws.emulation import Steps, control, running, until
from tests.sky.emulated_aws.pool import kill_server, process_on
from tests.sky.emulated_aws.under_contract import RESOURCES, adapter, stub_server

UID = "00000000000000aa"
TASK = {
    "resources": RESOURCES,
    "envs": {"GREETING": "hello"},
    "setup": "echo setup of the pool file: $GREETING > ~/setup-ran",
    "run": "unused",
}
FILES = {"replica.yaml": b"slot: 0\n", "replica.key": b"secret\n"}
step = Steps()


def get(endpoint: str, path: str = "/") -> str:
    try:
        return str(urllib.request.urlopen(f"http://{endpoint}{path}", timeout=3).read().decode())
    except (OSError, urllib.error.URLError):
        return ""


def state_of(machine: dict[str, Any]) -> str:
    listed = control("/instances", post=False)
    return next(str(one["state"]) for one in listed if one["id"] == machine["id"])


class Proof:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.cloud = self.another_process()

    def another_process(self) -> SkyCloud:
        return adapter(self.folder)

    def offer(self, region: str) -> Offer:
        offers = self.cloud.offers(RESOURCES)
        return next(o for o in offers if o.placement.region == region and o.placement.spot)

    def launch(self, slot: int, generation: int, region: str, **task: Any) -> ReplicaId:
        id, offer = ReplicaId(UID, slot, generation), self.offer(region)
        self.cloud.launch(
            Launch(
                id, "proof", offer.placement, offer.usd_per_hour, "abcd", {**TASK, **task}, FILES
            )
        )
        return id

    def machine(self, id: ReplicaId) -> Machine | None:
        return next((m for m in self.cloud.machines(UID) if m.id == id), None)

    def phase(self, id: ReplicaId) -> MachinePhase | None:
        machine = self.machine(id)
        if machine is not None and machine.phase is MachinePhase.FAILED:
            print(f"{id.short}: {machine.failure}", flush=True)
        return machine and machine.phase

    def runs(self, id: ReplicaId) -> Machine:
        ended = (MachinePhase.RUNNING, MachinePhase.FAILED)
        until(f"{id.short} runs", lambda: self.phase(id) in ended)
        machine = self.machine(id)
        assert machine is not None
        assert machine.phase is MachinePhase.RUNNING, machine.failure
        return machine

    def run(self) -> None:
        a, b = self.two_regions()
        self.preemption(a)
        self.standby()
        self.capacity_and_setup()
        self.another_takes_over(b)
        self.server_dies(b)
        self.everything_ends(b)

    def two_regions(self) -> tuple[ReplicaId, ReplicaId]:
        with step("check credentials"):
            assert self.cloud.check(["aws"]) == {"aws": ""}
        with step("offers"):
            offers = self.cloud.offers(RESOURCES)
        assert {o.source for o in offers} == {"live"}
        more = offers[0].extras_usd_per_hour
        assert (offers[0].usd_per_hour, more > 0) == (0.019 + more, True)
        assert {o.placement.region for o in offers} == {"us-east-1", "us-west-2", "eu-west-1"}
        with step("launch two, until SkyPilot has accepted both"):
            a = self.launch(0, 1, "us-east-1")
            b = self.launch(1, 1, "us-west-2")
        assert {m.phase for m in self.cloud.machines(UID)} == {MachinePhase.PROVISIONING}
        with step("... until both run"):
            first, second = self.runs(a), self.runs(b)
        assert first.endpoint is not None
        assert second.endpoint is not None
        assert {first.placement.region, second.placement.region} == {"us-east-1", "us-west-2"}
        with step("... until set-up is done and the service answers"):
            until("a answers", lambda: get(first.endpoint or ""))
            until("b answers", lambda: get(second.endpoint or ""))
        with step("... until SkyPilot says so, too"):  # a launch under way keeps its own machine
            listed = self.cloud.machines
            until("both are set up", lambda: not any(one.setting_up for one in listed(UID)))
        # What the VM got: the user's set-up, fogft from our wheel, the replica's files and no more.
        assert "hello" in get(first.endpoint, "/setup-ran")
        assert "Usage: fogft" in get(first.endpoint, "/fogft-help")
        assert get(first.endpoint, "/modes").split() == ["700", "600"]
        for instance in running():
            assert instance["labels"]["fogft-pool"] == UID
            assert instance["spot"]
        with step("list, from SkyPilot's memory"):
            assert len(self.cloud.machines(UID)) == 2
        return a, b

    def preemption(self, a: ReplicaId) -> None:
        mine = next(i for i in running() if i["labels"]["fogft-slot"] == "0")
        control(f"/preempt?id={mine['id']}")
        with step("detect a preemption: targeted refresh, then the list"):
            self.cloud.refresh(a)
            left = self.cloud.machines(UID)
        assert [m.id.slot for m in left] == [1], left
        with step("terminate what is gone already"):
            self.cloud.terminate(a)

    def standby(self) -> None:
        """An on-demand machine is stopped and started: its disk is kept, its address is another."""
        offer = self.cloud.offers({**RESOURCES, "use_spot": False})[0]
        id, price = ReplicaId(UID, 100, 1), offer.usd_per_hour
        order = Launch(id, "proof", offer.placement, price, "abcd", TASK, FILES)
        with step("an on-demand machine is launched, until it answers"):
            self.cloud.launch(order)
            before = self.runs(id).endpoint or ""
            until("it answers", lambda: get(before))
        with step("it is stopped"):
            self.cloud.stop(order)
        assert self.phase(id) is MachinePhase.STOPPED
        assert not [i for i in running() if i["labels"]["fogft-slot"] == "100"]
        with step("it is started, until it answers"):
            self.cloud.launch(replace(order, is_there=True))
            until("it answers", lambda: (m := self.machine(id)) and get(m.endpoint or ""))
        after = self.machine(id)
        assert after is not None
        assert after.endpoint not in (None, before)
        (mine,) = (i for i in running() if i["labels"]["fogft-slot"] == "100")
        with step("the guard that each boot starts shuts it down, and it ends"):
            guard = process_on(mine, "fogft-guard")
            within = ["nsenter", "-t", guard, "-m", "-p", "-r", "-w"]
            subprocess.run([*within, "shutdown"], check=False)  # the end may take it along
            until("it has ended, not merely stopped", lambda: state_of(mine) == "terminated")
        self.cloud.terminate(id)

    def capacity_and_setup(self) -> None:
        for region in ("us-east-1", "us-west-2"):
            control(f"/capacity?place={region}&has=0")
        with step("a launch without capacity, until it is listed as failed"):
            c = self.launch(0, 2, "us-east-1")
            until("c has failed", lambda: self.phase(c) is MachinePhase.FAILED)
        machine = self.machine(c)
        assert machine is not None
        assert machine.failure is not None
        assert machine.failure.cause is Cause.CAPACITY, machine.failure
        self.cloud.terminate(c)
        with step("a launch whose set-up fails, until its VM is gone"):
            d = self.launch(0, 3, "eu-west-1", setup="echo no such package: yolo; exit 3")
            until("d has failed", lambda: self.phase(d) is MachinePhase.FAILED)
            until("d's VM is gone", lambda: len(running()) == 1)
        machine = self.machine(d)
        assert machine is not None
        assert machine.failure is not None
        assert machine.failure.cause is Cause.SETUP, machine.failure
        assert "yolo" in machine.failure.words, machine.failure
        self.cloud.terminate(d)
        for region in ("us-east-1", "us-west-2"):
            control(f"/capacity?place={region}&has=1")

    def another_takes_over(self, b: ReplicaId) -> None:
        e = self.launch(0, 4, "us-east-1")
        self.cloud.close()
        self.cloud = self.another_process()
        with step("another process takes a launch over, until it runs"):
            self.runs(e)
        assert {m.id for m in self.cloud.machines(UID)} == {b, e}
        control("/late?s=8")
        f = self.launch(2, 1, "eu-west-1")
        until("f's VM exists", lambda: len(running()) == 3)
        with step("terminate in mid launch, before AWS lists the VM"):
            self.cloud.terminate(f)
        control("/late?s=0")
        assert len(running()) == 2
        with step("terminate a running replica"):
            self.cloud.terminate(e)
        assert [i["labels"]["fogft-slot"] for i in running()] == ["1"]

    def server_dies(self, b: ReplicaId) -> None:
        kill_server()
        self.cloud.close()
        self.cloud = self.another_process()  # one that remembers no list
        with step("SkyPilot's API server is killed; until machines are listed again"):

            def listed() -> bool:
                try:
                    return [m.id for m in self.cloud.machines(UID)] == [b]
                except CloudUnreachable as error:
                    print(error.message, flush=True)
                    return False

            until("the list is back", listed)

    def everything_ends(self, b: ReplicaId) -> None:
        with step("terminate the last one"):
            self.cloud.terminate(b)
        with step("sweep: nothing of any pool is left"):
            assert not self.cloud.audit().machines
        assert not running()
        assert not self.cloud.machines(UID)


def main() -> int:
    stub_server()
    try:
        Proof(Path("/robot/fogft/sky")).run()
    finally:
        step.write("adapter")
    print("every step passed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
