"""Whole pools through `fogft` itself, with unmodified SkyPilot on the emulated AWS.

Runs inside a world (`world.sh`). Replicas are real server proxies with a real service on VMs
of their own; the robot has a real client proxy and an ordinary rclpy client that asks all the
time. Machines are preempted with notice and without, a region runs out of capacity, the
manager is killed in the middle of a launch: no request may fail. At the end the account is
empty, and nothing of it runs here any more.

Prints a table of steps and writes it to the folder $RESULTS; ends with status 1 at the first
thing wrong.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.e2e.pool import Client
from tests.sky.emulated_aws import timetable
from tests.sky.emulated_aws.emulation import Steps, control, disk_of, running, until
from tests.sky.emulated_aws.home import MARK
from tests.sky.emulated_aws.pool import (
    HOME,
    Pool,
    clusters,
    machine_of,
    reaches,
    region_of,
)

RATE_HZ = 5.0
LAUNCHER, STRANGER = "10.66.0.1", "10.66.255.9"  # both addresses of the computer that launches
REGIONS = ("us-east-1", "us-west-2", "eu-west-1")
POOL_FILE = f"""\
name: proof
resources:
  cpus: 2
  use_spot: true
  any_of: [{", ".join(f"{{infra: aws/{region}}}" for region in REGIONS)}]
workdir: .
envs: {{GREETING: hello}}
secrets: {{TOKEN: t0p-secret}}
setup: |
  set -e
  pip install iniconfig
  echo "setup of $GREETING with $TOKEN" >> ~/setup-ran
run: |
  set -e
  python3 -c "import iniconfig"
  echo "$GREETING $TOKEN" > ~/run-found
  exec python3 plan_service.py
fogft:
  replicas: 2
  allow_from: [{LAUNCHER}]
  services:
    - {{name: /plan, type: nav_msgs/srv/GetPlan, timeout_s: 10}}
"""
step = Steps()


def credentials_below(disk: Path) -> Iterator[Path]:
    """Yield the files of a VM's disk that hold what should not leave the launching computer."""
    for path in disk.rglob("*"):
        code = "site-packages" in path.parts or ".cache" in path.parts
        if code or path.name == "replica.key" or not path.is_file():
            continue
        content = path.read_bytes() if path.stat().st_size < 65_536 else b""
        if any(mark in content for mark in (MARK.encode(), b"aws_secret", b"PRIVATE KEY-----")):
            yield path


class Proof:
    def __init__(self) -> None:
        self.pool = Pool(POOL_FILE)
        self.client: Client | None = None
        self.machines = timetable.Machines()
        self.reactions: list[str] = []
        self.result: dict[str, Any] = {}
        self.skypilots: list[timetable.Span] = []

    def whole(self, count: int) -> None:
        """Wait until the pool is whole; note when its new machines were set up."""
        until("the pool is whole", lambda: self.pool.whole(count))
        self.machines.look()

    def react(self, cause: str, words: str, *effects: tuple[str, str]) -> None:
        """Note how long after the cloud's last deed of a kind the manager did what."""
        at = [e["at"] for e in control("/log", post=False) if e["event"] == cause][-1]
        log = timetable.events(self.pool.state / "manager.log")
        steps = [f"{seconds:.2f} s until {name}" for name, seconds in
                 timetable.reaction(log, at, effects)]  # fmt: skip
        self.reactions.append(f"{words}: {', then '.join(steps)}")
        print(self.reactions[-1], flush=True)

    def run(self) -> None:
        self.nothing_without_a_yes()
        self.up()
        self.what_a_machine_has()
        self.preempted_without_notice_and_a_region_is_full()
        self.preempted_with_notice()
        self.manager_dies_in_mid_launch()
        self.scale_down()
        self.requests()
        self.down()

    def nothing_without_a_yes(self) -> None:
        control("/quota?region=eu-west-1&code=L-34B43A08&vcpus=0")  # as in most new accounts
        with step("`up` starts SkyPilot's API server and asks, and nobody says yes"):
            said = self.pool.fogft("up", str(self.pool.file), status=1)
        print(said)
        assert "`aws` can be used" in said
        assert "live, " in said
        assert "spot in `aws/eu-west-1` is left out: the quota L-34B43A08 allows 0 vCPUs" in said
        assert "cannot ask for confirmation: there is no terminal" in said
        assert not running()
        control("/quota?region=eu-west-1&code=L-34B43A08&vcpus=64")
        assert not HOME.exists() or not list((HOME / "pools").glob("*"))

    def up(self) -> None:
        with step("`up --yes`, until the service answers"):
            print(self.pool.fogft("up", str(self.pool.file), "--yes"))
        self.client = Client(self.pool.environ, 3600.0, RATE_HZ, 15.0)
        with step("... until both replicas are ready"):
            self.whole(2)
        assert {region_of(r) for r in self.pool.replicas().values()} == {"us-east-1", "us-west-2"}

    def what_a_machine_has(self) -> None:
        """The VM has what the pool file and the template promise, and nothing more."""
        status = self.pool.status()
        for name in self.pool.replicas():
            instance = machine_of(name)
            assert instance["spot"]
            assert instance["labels"]["fogft-pool"] == status["uid"]
            home = disk_of(instance) / "home/ubuntu"
            assert (home / "setup-ran").read_text() == "setup of hello with t0p-secret\n"
            assert (home / "run-found").read_text() == "hello t0p-secret\n"
            ours = home / ".fogft/replica"
            files = {"announcements.json", "replica.yaml", "ca.crt", "replica.crt", "replica.key"}
            assert {path.name for path in ours.iterdir()} == files
            modes = {path.stat().st_mode & 0o777 for path in (ours, *ours.iterdir())}
            assert modes == {0o700, 0o600}, modes
            (carried,) = (home / ".fogft/wheel").glob("fogft-*.whl")
            (made,) = (HOME / "sky/wheels").glob("*/fogft-*.whl")
            assert carried.read_bytes() == made.read_bytes()
            left = list(credentials_below(disk_of(instance)))
            assert not left, left
            # Ssh, which is SkyPilot's, and the link: to whom the file names, and to nobody else.
            for port in (22, 7448):
                assert reaches(instance["ip"], port, LAUNCHER)
                assert not reaches(instance["ip"], port, STRANGER)

    def preempted_without_notice_and_a_region_is_full(self) -> None:
        lost = next(n for n, r in self.pool.replicas().items() if region_of(r) == "us-east-1")
        place = self.pool.replicas()[lost]["location"]
        control("/capacity?place=us-east-1&has=0")
        with step("preempted without notice: until its replacement is launched"):
            control(f"/preempt?id={machine_of(lost)['id']}")
            until("it is being replaced", lambda: len(self.pool.others(lost)) == 2)
        tried = [e for e in self.pool.status()["events"] if e["event"] == "launched"]
        assert tried[-1]["location"] != place, tried
        self.react("preempt", "preempted", ("refresh_ordered", lost), ("replica_gone", lost),
                   ("launch_ordered", ""))  # fmt: skip
        with step("... its region has no capacity left: until whole again, elsewhere"):
            self.whole(2)
        failed = [
            e
            for e in self.pool.status()["events"]
            if (e["reason"] or {}).get("cause") == "capacity"
        ]
        assert failed
        regions = {region_of(r) for r in self.pool.replicas().values()}
        assert regions == {"us-west-2", "eu-west-1"}
        control("/capacity?place=us-east-1&has=1")
        with step("... until SkyPilot's records are those of the pool"):
            until("they are", lambda: clusters() == self.pool.clusters())

    def preempted_with_notice(self) -> None:
        warned = next(n for n, r in self.pool.replicas().items() if r["generation"] == 1)
        with step("preemption notice: until its replacement is launched"):
            control(f"/notice?id={machine_of(warned)['id']}&in_s=120")
            until("it is being replaced", lambda: len(self.pool.others(warned)) == 2)
        self.react("notice", "notice given", ("launch_ordered", warned))
        with step("... until whole, the one that was warned ended"):
            self.whole(2)
        assert warned not in self.pool.replicas()

    def manager_dies_in_mid_launch(self) -> None:
        before = {*self.pool.replicas()}
        with step("`scale up 1`, until its machine exists"):
            self.pool.fogft("scale", "up", "1")
            until("it exists", lambda: len(running()) == 3)
        os.kill(self.pool.pid("manager"), signal.SIGKILL)
        with step("the manager is killed in mid launch; the client proxy or `up` starts another"):
            self.pool.fogft("up", str(self.pool.file))
        with step("... until whole again, with the same launch"):
            self.whole(3)
        assert before < {*self.pool.replicas()}
        assert len(running()) == 3

    def scale_down(self) -> None:
        with step("`scale down 1`, until the account has two machines"):
            self.pool.fogft("scale", "down", "1")
            until("two are left", lambda: self.pool.whole(2) and len(running()) == 2)

    def requests(self) -> None:
        assert self.client is not None
        result = self.client.finish()
        print(json.dumps(result))
        assert result["requests"] > 100
        assert result["answered"] == result["requests"], result
        assert result["failed"] == result["wrong"] == result["twice"] == 0, result
        self.result = result

    def down(self) -> None:
        self.pool.keep_log()
        with step("`down`, verified with the cloud"):
            print(self.pool.fogft("down"))
        assert not running()
        assert not clusters()
        assert not list((HOME / "pools").glob("*"))
        self.skypilots = timetable.skypilots(self.machines)  # its server remembers, while it runs
        self.pool.leave_nothing()


def main() -> int:
    results = Path(os.environ["RESULTS"])
    proof = Proof()
    try:
        proof.run()
    finally:
        proof.pool.keep_log()
    told = [
        timetable.table(step.done, proof.skypilots),
        *(f"{line}\n" for line in proof.reactions),
        f"requests: {json.dumps(proof.result)}\n",
    ]
    print("\n" + "".join(told))
    (results / "pool.txt").write_text("".join(told))
    print("every step passed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
