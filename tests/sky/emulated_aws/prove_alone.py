"""VMs that nobody looks after any more end themselves, on unmodified SkyPilot.

Runs inside a world (`world.sh`). Three pools, and two more things that only a VM can show:

* `alone`: its image has ROS 2 at /opt/ros, and its replica dials the robot, so that no port is
  opened. It answers; then its manager is ended for good.
* `hangs`: its `setup` never ends. Its manager is ended, too.
* `unborn`: all of the robot ends when its VM has just been made: no job, no `autostop`.

So does SkyPilot's API server: the robot is gone. Each VM has to find out by itself, and to ask the
cloud to end it, or to shut itself down. To wait for minutes and not for hours, the template's five
idle minutes are made one, the limit of a set-up four minutes for `hangs`, and the one of a VM that
no replica runs on two for `unborn`: on a slow machine the others need longer. The changes vanish
with the world.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.e2e.pool import Client
from tests.sky.emulated_aws.emulation import Steps, control, disk_of, running, until
from tests.sky.emulated_aws.pool import (
    HOME,
    Pool,
    kill_server,
    machine_of,
    open_ports,
    reaches,
)

TEMPLATES = Path(__file__).resolve().parents[3] / "templates"
OF_ALL = ("sky_task.yaml", "idle_minutes: 5", "idle_minutes: 1")
OF_HANGS = ("sky_task.yaml", "@SETUP_LIMIT_S@", "240")
OF_UNBORN = ("vm_guard.sh", "@ALONE_MINUTES@", "2")
DOOR = "10.66.0.1:7460"  # where VMs find the robot
UNMANAGED_MAX_S = 60
ALONE = f"""\
name: alone
resources: {{cpus: 2, use_spot: true, infra: aws/us-east-1}}
workdir: .
setup: |
  set -e
  # What an image with ROS 2 has: an installation at /opt/ros that is of no use until it is sourced.
  ros=/opt/ros/proof
  sudo mkdir -p $ros && sudo chown "$(id -un)" $ros
  ~/.local/bin/uv venv -q --python /usr/bin/python3 $ros
  ~/.local/bin/uv pip install -q --python $ros/bin/python /opt/wheelhouse/ros_*.whl numpy
  test ! -e build && test -e src  # what colcon built in the lab is of no use here
  packages=$(echo $ros/lib/python3*/site-packages)
  rm $packages/ros_wheels_bootstrapper.pth
  cat > $ros/setup.bash <<SETUP
  export ROS_DISTRO=proof PYTHONPATH=$packages
  export LD_LIBRARY_PATH=$(printf "%s:" $packages/ros_*.libs)$ros/lib
  SETUP
  pip install iniconfig
run: |
  set -e
  python3 -c "import iniconfig, rclpy"
  exec python3 plan_service.py
fogft:
  replicas: 1
  dial_in: {DOOR}
  unmanaged_max_hours: {UNMANAGED_MAX_S / 3600}
  services:
    - {{name: /plan, type: nav_msgs/srv/GetPlan, timeout_s: 10}}
"""
HANGS = """\
name: hangs
resources: {cpus: 2, use_spot: true, infra: aws/us-west-2}
workdir: .
setup: touch ~/setup-begun; setsid sleep 86400 & sleep 86400
run: exec python3 plan_service.py
fogft:
  replicas: 1
  services:
    - {name: /plan, type: nav_msgs/srv/GetPlan, timeout_s: 10}
"""
UNBORN = """\
name: unborn
resources: {cpus: 2, use_spot: true, infra: aws/eu-west-1}
run: exec python3 plan_service.py
fogft:
  replicas: 1
  services:
    - {name: /plan, type: nav_msgs/srv/GetPlan, timeout_s: 10}
"""
step = Steps()


def make_impatient(name: str, old: str, new: str) -> None:
    """Shorten one of the templates' waits."""
    text = (TEMPLATES / name).read_text()
    assert old in text
    (TEMPLATES / name).write_text(text.replace(old, new))


def up_and_left(pool: Pool) -> subprocess.Popen[bytes]:
    """Start `up`, which would wait for a pool that never answers."""
    return subprocess.Popen(
        [sys.executable, "-m", "fogft", "up", str(pool.file), "--yes"],
        env=pool.environ, cwd=pool.folder, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
    )  # fmt: skip


def of_pool(pool: Pool) -> list[dict[str, Any]]:
    if not (pool.state / "status.json").exists():
        return []
    uid = pool.status()["uid"]
    return [i for i in running() if i["labels"]["fogft-pool"] == uid]


def what_the_machine_has(pool: Pool) -> None:
    """No port but ssh's is open, and the ROS 2 that serves is the image's."""
    (name,) = pool.replicas()
    machine = machine_of(name)
    assert open_ports(machine["region"], "sky-sg-") == {22}
    assert reaches(machine["ip"], 22)
    assert not reaches(machine["ip"], 7448)
    disk = disk_of(machine)
    assert list(disk.glob("opt/ros/proof/lib/python3*/site-packages/rclpy"))
    (packages,) = disk.glob("home/ubuntu/.fogft/venv/lib/python3*/site-packages")
    assert (packages / "fogft").is_dir()
    assert not (packages / "rclpy").exists(), "fogft has brought another ROS 2"


def kill(pool: Pool) -> None:
    """End a manager for good: one that is killed is started again."""
    os.kill(pool.pid("manager"), signal.SIGTERM)


def leave(pool: Pool, waiting: subprocess.Popen[bytes]) -> None:
    """End a manager for good, and the `up` that waits for its pool."""
    kill(pool)
    waiting.kill()
    waiting.wait()


def main() -> int:
    make_impatient(*OF_ALL)
    alone, hangs, unborn = Pool(ALONE), Pool(HANGS), Pool(UNBORN)
    for name in ("src/greet/package.xml", "build/COLCON_IGNORE", "build/greet/CMakeCache.txt"):
        (alone.folder / name).parent.mkdir(parents=True, exist_ok=True)
        (alone.folder / name).write_text("CMAKE_HOME_DIRECTORY:INTERNAL=/lab/src/greet\n")
    with step("`up` with ROS 2 in the image and a replica that dials out, until it answers"):
        print(alone.fogft("up", str(alone.file), "--yes"))
    client = Client(alone.environ, 3600.0, 5.0, 15.0)
    what_the_machine_has(alone)
    make_impatient(*OF_HANGS)
    waiting = up_and_left(hangs)

    def hanging() -> bool:
        return any((disk_of(i) / "home/ubuntu/setup-begun").exists() for i in of_pool(hangs))

    with step("`up` whose `setup` hangs, until it does"):
        until("it hangs", hanging)
    result = client.finish()
    print(result)
    assert result["answered"] == result["requests"] > 10, result
    assert result["failed"] == result["wrong"] == result["twice"] == 0, result
    assert len(running()) == 2
    leave(hangs, waiting)
    make_impatient(*OF_UNBORN)
    waiting = up_and_left(unborn)
    with step("`up` of a third pool, until its VM exists"):
        until("it exists", lambda: of_pool(unborn))
    (newborn,) = of_pool(unborn)
    leave(unborn, waiting)
    kill(alone)
    kill_server()
    with step("manager and API server are gone: until the VM that hangs has ended itself"):
        until("it is gone", lambda: not of_pool(hangs))
    with step("... until the replica without a manager has ended itself, too"):
        until("it is gone", lambda: not of_pool(alone))
    with step("... until the VM that was never set up has shut itself down"):
        until("it is gone", lambda: not running())
    by_themselves = [e for e in control("/log", post=False) if e["event"] == "shutdown"]
    assert [one["id"] for one in by_themselves] == [newborn["id"]], by_themselves
    told = [e for e in control("/log", post=False) if e["event"] in ("preempt", "refused")]
    assert not told, told
    for pool in (alone, hangs, unborn):
        with step(f"`down` of `{pool.name}`, which finds nothing"):
            pool.down()
    assert not list((HOME / "pools").glob("*"))
    alone.leave_nothing()
    step.write("alone")
    print("every step passed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
