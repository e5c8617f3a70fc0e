"""A replica in a container of the user's own image: unmodified SkyPilot and a real Docker daemon.

Runs inside a world (`world.sh`, with `CONTAINERS=1`). The image has ROS 2 at /opt/ros and no fogft;
SkyPilot pulls it from a registry, starts it with the machine's own network and goes into it over
ssh. There the replica answers. An image that `fogft bake` made of the pool file takes its place;
that one's replica hears its machine's preemption notice, and, when its manager is
ended for good, has its machine ended. To wait for minutes and not for hours, the five idle minutes
are made one.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from tests.e2e.pool import Client
from tests.sky.emulated_aws.emulation import IMAGE, Steps, control, disk_of, running, until
from tests.sky.emulated_aws.pool import (
    HOME,
    Pool,
    kill_server,
    machine_of,
    open_ports,
    process_on,
)

TEMPLATE = Path(__file__).resolve().parents[3] / "templates" / "sky_task.yaml"
REGISTRY = "10.66.0.1:5000"
BAKED = f"{REGISTRY}/lab/baked:1"
SECRETS = "secrets: {TOKEN: t0p-secret}\n"
BOXED = """\
name: boxed
resources:
  cpus: 2
  use_spot: true
  infra: aws/us-east-1
  image_id: docker:10.66.0.1:5000/ros:1
workdir: .
envs: {GREETING: hello}
secrets: {TOKEN: t0p-secret}
setup: |
  set -e
  test -f /.dockerenv
  pip install iniconfig
  echo "$GREETING $TOKEN" > ~/setup-ran
run: |
  set -e
  test -f /.dockerenv
  grep -qx "hello t0p-secret" ~/setup-ran
  python3 -c "import iniconfig"
  exec python3 plan_service.py
fogft:
  replicas: 1
  unmanaged_max_hours: 0.0167
  services:
    - {name: /plan, type: nav_msgs/srv/GetPlan, timeout_s: 10}
"""
step = Steps()


def start_docker() -> None:
    """Start a Docker daemon on the launching machine, as on the VMs (`vm.sh`)."""
    for kind, source, where in (
        ("-t sysfs", "sysfs", "/sys"),
        ("--rbind", str(IMAGE / "cgroup"), "/sys/fs/cgroup"),
        ("-t tmpfs", "tmpfs", "/var/lib/docker"),  # an overlay cannot lie on another one
    ):
        Path(where).mkdir(parents=True, exist_ok=True)
        subprocess.run(["mount", *kind.split(), source, where], check=True)
    words = [
        "dockerd", "--iptables=false", "--bridge=none", f"--cgroup-parent=/{IMAGE.name}",
        "--add-runtime", "here=/usr/local/sbin/runc-here", "--default-runtime", "here",
        "--insecure-registry", REGISTRY,
    ]  # fmt: skip
    with Path("/var/log/dockerd.log").open("wb") as log:
        subprocess.Popen(words, stdout=log, stderr=log)
    asked = ["docker", "info"]
    until("Docker answers", lambda: subprocess.run(asked, capture_output=True).returncode == 0, 60)


def phases(pool: Pool) -> dict[str, float]:
    """Return how long each phase of the one replica took, in seconds."""
    (replica,) = pool.replicas().values()
    names = ("provisioning_s", "setup_s", "starting_s", "ready_after_s")
    return {name: replica[name] for name in names}


def main() -> int:
    text = TEMPLATE.read_text()
    assert "idle_minutes: 5" in text
    TEMPLATE.write_text(text.replace("idle_minutes: 5", "idle_minutes: 1"))
    pool = Pool(BOXED)
    try:
        with step("`up` in a container with ROS 2, until it answers"):
            print(pool.fogft("up", str(pool.file), "--yes"))
        client = Client(pool.environ, 3600.0, 5.0, 15.0)
        (name,) = pool.replicas()
        machine = machine_of(name)
        cluster = f"fogft-{pool.status()['uid']}-{name.replace('.', '-')}"
        assert open_ports(machine["region"], f"sky-sg-{cluster}") == {22, 7448}
        home = disk_of(machine) / "home/ubuntu"
        assert not (home / "setup-ran").exists(), "the set-up ran beside the container"
        assert not (home / ".fogft").exists(), "fogft is beside the container"
        start_docker()
        first = phases(pool)
        with step("`bake --push` runs the set-up in Docker and pushes the image"):
            (pool.folder / "bake.yaml").write_text(BOXED.replace(SECRETS, ""))
            print(pool.fogft("bake", "bake.yaml", "--tag", BAKED, "--push"))
        pool.file.write_text(BOXED.replace(f"{REGISTRY}/ros:1", BAKED))
        with step("`up` with that image, until a replica of it alone is ready"):
            pool.fogft("up", str(pool.file), "--yes")
            until("the pool is whole", lambda: pool.whole(1) and name not in pool.replicas())
        (name,) = pool.replicas()
        machine = machine_of(name)
        box = Path(f"/proc/{process_on(machine, 'plan_service.py')}/root/root")
        assert (box / "setup-ran").read_text() == "hello t0p-secret\n"
        made, ran = (box / one for one in (".fogft/venv/made-of", "setup-ran"))
        assert made.stat().st_mtime < ran.stat().st_mtime, "its environment is the image's"
        print(f"order to ready: {first}, of the baked image {phases(pool)}", flush=True)
        with step("preemption notice: until its replacement is launched"):
            control(f"/notice?id={machine['id']}&in_s=3600")
            until("it is being replaced", lambda: pool.others(name), 120)
        with step("... until whole, in another container, the one that was warned ended"):
            until("the pool is whole", lambda: pool.whole(1) and name not in pool.replicas())
        result = client.finish()
        print(result)
        assert result["answered"] == result["requests"] > 10, result
        assert result["failed"] == result["wrong"] == result["twice"] == 0, result
        os.kill(pool.pid("manager"), signal.SIGTERM)
        kill_server()
        with step("manager and API server are gone: until the replica has ended its machine"):
            until("it is gone", lambda: not running())
        with step("`down`, which finds nothing"):
            pool.down()
    finally:
        pool.keep_log()
    assert not list((HOME / "pools").glob("*"))
    pool.leave_nothing()
    step.write("container")
    print("every step passed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
