"""The adapter on unmodified SkyPilot and the emulated AWS, for the contract of every cloud.

In the server proxy's place a web server runs, which needs no credentials to stay alive.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from fogft.cloud.sky import task
from fogft.cloud.sky.adapter import SkyCloud
from fogft.cloud.sky.aws import Aws
from fogft.cloud.sky.installed import InstalledSky
from fogft.model.replica import ReplicaId
from tests.sky.emulated_aws.emulation import control, running, until

RESOURCES: Mapping[str, Any] = {
    "cpus": "2",
    "use_spot": True,
    "any_of": [{"infra": f"aws/{region}"} for region in ("us-east-1", "us-west-2", "eu-west-1")],
}


def stub_server() -> None:
    """Let a web server stand where the server proxy will: it shows what the VM looks like."""
    read = task.read

    def with_stub() -> dict[str, Any]:
        made = read()
        made["run"] = (
            "cd ~ && mkdir -p shown && cp setup-ran shown/ 2>/dev/null; cd ~/shown\n"
            "~/.fogft/venv/bin/fogft --help > fogft-help\n"
            "stat -c %a ~/.fogft/replica ~/.fogft/replica/replica.key > modes\n"
            "exec python3 -m http.server @PORT@\n"
        )
        return made

    task.read = with_stub


def adapter(folder: Path) -> SkyCloud:
    """Return an adapter as another process would have it."""
    return SkyCloud(folder, InstalledSky(), [Aws()], owner="proof")


def preempt(cloud: SkyCloud, id: ReplicaId) -> None:
    """Take a machine away, and ask about it as when its probes go unanswered."""
    slot, generation = str(id.slot), str(id.generation)
    wanted = {"fogft-pool": id.pool_uid, "fogft-slot": slot, "fogft-generation": generation}
    mine = next(i for i in running() if wanted.items() <= i["labels"].items())
    control(f"/preempt?id={mine['id']}")
    cloud.refresh(id)


def fill(location: str) -> None:
    """Leave no spot capacity in a zone."""
    control(f"/capacity?place={location.rsplit('/', 1)[1]}&has=0")


def emulated(folder: Path, make: Callable[..., Any]) -> Iterator[Any]:
    """Yield the cloud under test; at the end everything has capacity, and nothing runs.

    Args:
        folder: Where launches are remembered.
        make: `CloudUnderTest`.
    """
    stub_server()
    cloud = adapter(folder)
    assert cloud.check(["aws"]) == {"aws": ""}  # as `up` does first: it starts SkyPilot's server
    filled: list[str] = []

    def fill_and_note(location: str) -> None:
        filled.append(location)
        fill(location)

    try:
        yield make(
            cloud,
            resources=RESOURCES,
            impossible={"infra": "aws/atlantis"},
            wait_until=lambda is_so: until("the contract's condition", is_so),
            fill=fill_and_note,
            preempt=lambda id, _: preempt(cloud, id),
            notices=False,
            files={"replica.yaml": b"x: 1", "replica.key": b"secret"},
        )
        assert not running()
    finally:
        for location in filled:
            control(f"/capacity?place={location.rsplit('/', 1)[1]}&has=1")
        cloud.close()
