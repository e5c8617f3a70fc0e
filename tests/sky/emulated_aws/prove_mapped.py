"""A cloud that maps ports, sells nothing on spot and is soon full: a fake RunPod.

Runs inside a world (`world.sh`), with unmodified SkyPilot. A replica is launched on a pod, reached
where its port is mapped
to, found again by a process that knows nothing, and ended; a second one does not fit.
Prints a table of steps; ends with status 1 at the first thing wrong.
"""

from __future__ import annotations

import json
import sys
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from fogft.cloud.port import Launch
from fogft.cloud.sky.adapter import SkyCloud
from fogft.cloud.sky.installed import InstalledSky
from fogft.errors import SpecError
from fogft.model.reason import Cause
from fogft.model.replica import Machine, MachinePhase, ReplicaId
from tests.sky.emulated_aws.emulation import Steps, until
from tests.sky.emulated_aws.home import text, write
from tests.sky.emulated_aws.prove_adapter import FILES, TASK, UID, get
from tests.sky.emulated_aws.runpod_api import KEY, PORT
from tests.sky.emulated_aws.under_contract import stub_server

COLUMNS = "InstanceType,AcceleratorName,AcceleratorCount,vCPUs,MemoryGiB,GpuInfo,Price,SpotPrice,"
ROWS = [
    [kind, "", "", cpus, 4 * cpus, "", 0.03 * cpus, "", "CA", "CA-MTL-1"]
    for kind, cpus in (("cpu3c-2-8", 2), ("cpu3c-4-16", 4))
]
RESOURCES = {"infra": "runpod", "cpus": "2", "use_spot": False}
POD_TASK = {**TASK, "resources": RESOURCES}
step = Steps()


def pods() -> list[dict[str, Any]]:
    return list(json.load(urllib.request.urlopen(f"http://127.0.0.1:{PORT}/pods", timeout=30)))


def adapter(folder: Path) -> SkyCloud:
    return SkyCloud(folder, InstalledSky(), [], owner="proof")


def launched(cloud: SkyCloud, slot: int) -> Machine:
    """Launch a replica; return it as it is once it runs or has failed."""
    offer = cloud.offers(RESOURCES)[0]
    id = ReplicaId(UID, slot, 1)
    cloud.launch(Launch(id, "proof", offer.placement, offer.usd_per_hour, "abcd", POD_TASK, FILES))

    def settled() -> Machine | None:
        found = next(m for m in cloud.machines(UID) if m.id == id)
        ready = found.phase is MachinePhase.FAILED or found.endpoint
        return found if ready else None

    machine: Machine = until(f"{id.short} has come to something", settled)
    return machine


def main() -> int:
    home = Path.home()
    folder = next((home / ".sky/catalogs").iterdir()) / "runpod"
    write(folder / "vms.csv", [*COLUMNS.rstrip(",").split(","), "Region", "AvailabilityZone"], ROWS)
    text(home / ".runpod/config.toml", f'[default]\napi_key = "{KEY}"\n')
    stub_server()
    cloud = adapter(home / "mapped")
    with step("check credentials"):
        assert cloud.check(["runpod"]) == {"runpod": ""}
    with step("nothing is sold on spot, and `plan` says so"):
        with pytest.raises(SpecError, match="`runpod` is left out"):
            cloud.offers({**RESOURCES, "use_spot": True})
    with step("a replica is launched, until it is known where its port is mapped to"):
        machine = launched(cloud, 0)
        assert machine.failure is None, machine.failure
    (pod,) = pods()
    ports = {one["privatePort"]: one["publicPort"] for one in pod["runtime"]["ports"]}
    assert machine.endpoint == f"10.66.0.1:{ports[7448]}" != "10.66.0.1:7448"
    with step("... until it answers there"):
        until("it answers", lambda: get(machine.endpoint or ""))
    assert "hello" in get(machine.endpoint or "", "/setup-ran")
    with step("another process that knows nothing finds it"):
        other = adapter(home / "elsewhere")
        (found,) = other.machines(UID)
        assert (found.id, found.phase) == (machine.id, MachinePhase.RUNNING)
    with step("a second one does not fit, and is told as that"):
        second = launched(cloud, 1)
        assert second.failure is not None
        assert second.failure.cause is Cause.CAPACITY
        assert "no longer any instances available" in second.failure.words, second.failure
        cloud.terminate(second.id)
    with step("the replica ends"):
        cloud.terminate(machine.id)
        assert not pods()
        assert not cloud.machines(UID)
    return 0


if __name__ == "__main__":
    sys.exit(main())
