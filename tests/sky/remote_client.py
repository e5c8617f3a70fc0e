"""A robot without cloud credentials, on an API server elsewhere. Run by `test_remote_server`.

Prints one JSON object: what it was told, step by step.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fogft.cloud.port import Launch
from fogft.cloud.sky import adapter as sky
from fogft.model.replica import MachinePhase, ReplicaId

ID = ReplicaId("00000000000000aa", 0, 1)
RESOURCES = {"infra": "aws/us-east-1", "cpus": "2", "use_spot": True}
LIMIT_S = 300.0


def main(folder: Path) -> dict[str, Any]:
    cloud = sky.make(folder / "state")
    told: dict[str, Any] = {"check": dict(cloud.check(["aws"]))}
    told["unverified"] = cloud.unverified("aws")
    offers = cloud.offers(RESOURCES)
    told["offers"] = [(o.placement.location, o.placement.instance, o.source) for o in offers]
    (folder / "work").mkdir()
    (folder / "work" / "model.bin").write_bytes(b"x" * 1000)
    task = {"run": "true", "resources": RESOURCES, "workdir": "work"}
    files = {"replica.yaml": b"x: 1", "replica.key": b"secret"}
    cloud.launch(Launch(ID, "p", offers[0].placement, 0.02, "0" * 16, task, files))
    told["listed"] = [(m.id.short, m.phase.value) for m in cloud.machines(ID.pool_uid)]
    (folder / "launched").touch()
    wait(lambda: (folder / "seen").exists())  # the test has seen the VM at the provider
    machine = next(iter(cloud.machines(ID.pool_uid)))
    told["before"] = (machine.phase.value, machine.failure and machine.failure.cause.value)
    cloud.terminate(ID)
    told["after"] = [m.id.short for m in cloud.machines(ID.pool_uid)]
    audit = cloud.audit(ID.pool_uid)
    told["audit"] = ([m.id.short for m in audit.machines], sorted(audit.asked))
    cloud.close()
    assert machine.phase is not MachinePhase.FAILED
    return told


def wait(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.1)


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]))))
