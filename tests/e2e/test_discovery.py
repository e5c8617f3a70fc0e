"""A pool whose file lists no services offers what `run` advertises, as a robot sees it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import pytest

from tests.e2e.pool import NODES, Pool
from tests.needs import needs

pytestmark = [pytest.mark.e2e, pytest.mark.ros, pytest.mark.timeout(240)]

OFFERED = {
    "/arm/turn": ["std_srvs/srv/SetBool"],  # `flip`, remapped, in the namespace
    "/arm/worker/reset": ["std_srvs/srv/Trigger"],  # `~/reset` of the renamed node
    "/plan": ["nav_msgs/srv/GetPlan"],  # absolute: no namespace touches it
}


def robot(
    pool: Pool, name: str, kind: str, seconds: float = 20, others: Iterable[str] = ()
) -> dict:
    done = subprocess.run(
        [sys.executable, str(NODES / "robot.py"), name, kind, str(seconds), *others],
        env=pool.environ, capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@contextmanager
def waiting(pool: Pool, name: str, kind: str) -> Iterator[Iterator[str]]:
    """Start a node that waits for a service to come, go and come; yield what it says."""
    process = subprocess.Popen(
        [sys.executable, str(NODES / "waiting_robot.py"), name, kind],
        env=pool.environ, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    try:
        yield (line.strip() for line in process.stdout)
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def own(services: dict[str, list[str]]) -> dict[str, list[str]]:
    """Leave out what every node of rclpy has: the asking one, and the proxy's visible one."""
    return {n: t for n, t in services.items() if not n.startswith(("/robot/", "/fogft_"))}


def test_the_robot_is_offered_what_run_advertises(pool: Pool):
    """Names, namespaces and remappings as in ROS; nothing of ROS's own; kept across restarts.

    `wait_for_service` is true only while a replica can answer: all freeze, and the service goes;
    one goes on, and it is there again.
    """
    names = "-r __ns:=/arm -r __node:=worker -r flip:=turn"
    pool.file.write_text(
        "name: e2e\n"
        "resources: {any_of: [{infra: local/us-west-1}, {infra: local/us-west-2}]}\n"
        f"run: exec {sys.executable} {NODES}/several_services.py --ros-args {names}\n"
        "fogft: {replicas: 2}\n"
    )
    pool.up()
    seen = robot(pool, "/arm/worker/reset", "std_srvs/srv/Trigger", others=OFFERED)
    assert own(seen["services"]) == OFFERED
    assert "message='/arm/worker'" in seen["answer"]
    assert "success=True" in robot(pool, "/arm/turn", "std_srvs/srv/SetBool")["answer"]
    status = pool.status()
    assert {s["name"]: s["ready_replicas"] for s in status["services"]} == dict.fromkeys(OFFERED, 2)

    # The manager, the client proxy and every replica die; the offer does not.
    os.kill(status["manager_pid"], signal.SIGKILL)
    os.kill(status["proxy_pid"], signal.SIGKILL)
    pool.up()
    seen = robot(pool, "/plan", "nav_msgs/srv/GetPlan", others=OFFERED)
    assert own(seen["services"]) == OFFERED
    assert {r["generation"] for r in pool.status()["replicas"]} == {1}, "nothing was replaced"

    with waiting(pool, "/plan", "nav_msgs/srv/GetPlan") as said:
        assert next(said) == "there"
        for slot in ("0", "1"):
            pool.fogft("chaos", "freeze", slot)
        assert next(said) == "gone"
        for slot in ("0", "1"):
            pool.fogft("chaos", "thaw", slot, ok=False)  # it may have been replaced
        assert next(said) == "there"
        assert next(said).startswith("nav_msgs.srv.GetPlan_Response(")


@needs("ros2service")
def test_ros2_service_list_type_and_call_go_through_the_proxy(pool: Pool):
    """With the real `ros2` command."""
    pool.file.write_text(
        "name: e2e\n"
        f"run: exec {sys.executable} {NODES}/several_services.py\n"
        "resources: {infra: local/us-west-1}\n"
        "fogft: {replicas: 1}\n"
    )
    pool.up()

    def ros2(*words: str, ok: bool = True) -> str:
        code = "import sys; from ros2cli.cli import main; sys.exit(main())"
        done = subprocess.run(
            [sys.executable, "-c", code, "service", *words],
            env=pool.environ, capture_output=True, text=True, timeout=100, check=False,
        )  # fmt: skip
        assert done.returncode == 0 or not ok, done.stderr
        return done.stdout

    found = ros2("list", "--no-daemon", "--spin-time", "3", "-t").splitlines()
    # Beside them are the services that every node has: ros2cli's own, and the pool's visible one.
    assert {line for line in found if not line.startswith(("/_ros2cli", "/fogft_e2e/"))} == {
        "/flip [std_srvs/srv/SetBool]",
        "/plan [nav_msgs/srv/GetPlan]",
        "/several/reset [std_srvs/srv/Trigger]",
    }
    # `type` starts ros2cli's daemon and looks for half a second; the daemon ends with the pool.
    pool.wait(lambda: ros2("type", "/flip", ok=False) == "std_srvs/srv/SetBool\n", 60)
    said = ros2("call", "/flip", "std_srvs/srv/SetBool", "{data: false}")
    assert "success=True" in said
