"""What `fogft service install` writes, under a systemd that boots: killed, frozen, rebooted.

The client is a plain ROS 2 node on the machine's network: another computer, which goes on.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import fogft
from tests.boot.machine import ROOT, Machine, machine, wait
from tests.needs import needs

pytestmark = [needs("boot", "rclpy", "night"), pytest.mark.ros, pytest.mark.timeout(1200)]

NODES = ROOT / "tests" / "e2e" / "nodes"
HOME = "/home/robot"
STATE = f"{HOME}/.local/state/fogft"
ROS = {
    "PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin:/usr/sbin:/sbin",
    "PYTHONPATH": str(ROOT),
    "PYTHONDONTWRITEBYTECODE": "1",
    "ROS_DOMAIN_ID": "7",
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "NO_COLOR": "1",
}
POOL = f"""\
name: e2e
resources: {{any_of: [{{infra: local/us-west-1}}, {{infra: local/us-west-2}}]}}
run: exec {sys.executable} {NODES}/plan_service.py 0.005
fogft:
  replicas: 2
  services:
    - {{name: /plan, type: nav_msgs/srv/GetPlan, timeout_s: 10.0}}
"""
GATEWAY, MEETING = "127.0.0.1:7461", "127.0.0.1:7462"
BEHIND_A_GATEWAY = f"""\
  rendezvous: ['{MEETING}']
  topology: {{gateways: [{{name: east, endpoint: '{GATEWAY}'}}], default_gateways: [east]}}
"""
PARTS = tuple(f"fogft-e2e-{part}.service" for part in ("manager", "proxy-a", "proxy-b", "proxy-c"))


class Robot:
    """A machine with a user who has a pool, whose units are the machine's or the user's."""

    def __init__(self, made: Machine, *, system: bool) -> None:
        self.machine = made
        self._scope = ["--system"] if system else []
        made.run("useradd", "--create-home", "--shell", "/bin/bash", "robot")
        self._own = {"HOME": HOME, **ROS}
        if not system:
            made.run("loginctl", "enable-linger", "robot")
            uid = made.run("id", "--user", "robot").strip()
            self._own["XDG_RUNTIME_DIR"] = f"/run/user/{uid}"
            runs = ("systemctl", "is-active", f"user@{uid}")
            wait(lambda: made.run(*runs, ok=False).strip() == "active", made.log)
        self.write(f"{HOME}/pool.yaml", POOL)

    def write(self, path: str, text: str) -> None:
        self.machine.run("bash", "-c", f"cat >{path} <<'END'\n{text}\nEND", user="robot")

    def fogft(self, *words: str, ok: bool = True) -> str:
        """Run a command as the user."""
        command = [sys.executable, "-m", "fogft", *words]
        return self.machine.run(*command, user="robot", environ=self._own, ok=ok, limit_s=240)

    def join(self, role: str, name: str, listen: str) -> str:
        """Let another machine of the pool in, with a home of its own; return its configuration."""
        secret, other = f"{HOME}/secret", f"{HOME}/{name}"
        self.write(secret, "a passphrase that unknown")
        given = ("--passphrase-file", secret)
        out = ("--out", f"{HOME}/{name}.join")
        bundle = self.fogft("credentials", "issue", role, name, *out, *given).strip()
        joined = self.machine.run(
            *(sys.executable, "-m", "fogft", "join", bundle, *given),
            user="robot", environ={**self._own, "FOGFT_HOME": other},
        )  # fmt: skip
        config = joined.strip()
        text = "import sys, yaml; p = sys.argv[1]; given = yaml.safe_load(open(p)); "
        text += "given['listen'] = sys.argv[2]; open(p, 'w').write(yaml.safe_dump(given))"
        words = (sys.executable, "-c", text, config, listen)
        self.machine.run(*words, user="robot", environ=self._own)
        return config

    def path(self, path: str) -> None:
        """Have commands find fogft there."""
        self._own["PYTHONPATH"] = path

    def service(self, *words: str) -> str:
        """Run `fogft service`, for units of the machine as root, as `sudo` does."""
        if not self._scope:
            return self.fogft("service", *words)
        environ = {**ROS, "HOME": "/root", "FOGFT_HOME": STATE}
        command = [sys.executable, "-m", "fogft", "service", *words, *self._scope]
        return self.machine.run(*command, environ=environ, limit_s=240)

    def systemctl(self, *words: str) -> str:
        if self._scope:
            return self.machine.run("systemctl", *words, ok=False)
        command = ["systemctl", "--user", *words]
        return self.machine.run(*command, user="robot", environ=self._own, ok=False)

    def pid(self, unit: str) -> int:
        """Return a unit's process, as its machine counts; 0 for none that is ready."""
        shown = self.systemctl("show", "--property=MainPID,ActiveState", unit)
        values = dict(line.partition("=")[::2] for line in shown.splitlines())
        return int(values["MainPID"]) if values.get("ActiveState") == "active" else 0

    def pids(self, *, without: int = 0) -> dict[str, int]:
        """Return the units' processes once all are ready, and one that is to end has ended."""

        def found() -> dict[str, int] | None:
            known = {unit: self.pid(unit) for unit in PARTS}
            return known if all(pid not in (0, without) for pid in known.values()) else None

        return wait(found, lambda: self.systemctl("status", "fogft-*", "--no-pager", "-n30"), 240)

    def serving(self) -> str:
        """Return which of the units serves."""
        pid = json.loads(self.read("proxy-status.json"))["pid"]
        return next((unit for unit in PARTS if self.pid(unit) == pid), "")

    def serves(self, *units: str) -> None:
        """Wait until one of these units serves."""
        wait(lambda: self.serving() in units, lambda: self.systemctl("status", "--no-pager"), 240)

    def read(self, name: str) -> str:
        return self.machine.run("cat", f"{STATE}/pools/e2e/{name}")

    def whole(self) -> None:
        """Wait until every replica is ready and requests are answered."""

        def found() -> bool:
            status = self.machine.run(
                *(sys.executable, "-m", "fogft", "status", "--json"),
                user="robot", environ=self._own, ok=False,
            )  # fmt: skip
            try:
                shown = json.loads(status)
            except ValueError:
                return False
            ready = sum(one["phase"] == "ready" for one in shown["replicas"])
            return ready == 2 and bool(shown["answers"])

        wait(found, self.told, 240)

    def told(self) -> str:
        """Return what there is to read where it does not go on."""
        logs = self.machine.run(
            "bash", "-c", f"tail -n 30 {STATE}/local/machines/*/*.log; journalctl -n 60", ok=False
        )
        return self.fogft("status", ok=False) + self.read("manager.log") + logs

    def signal(self, name: str, pid: int) -> None:
        self.machine.run("kill", f"-{name}", str(pid))

    def client(self, seconds: float = 900) -> Client:
        return Client(self.machine, seconds)

    def answers(self) -> None:
        """See that the pool is whole, and that no request of the next seconds fails."""
        self.whole()
        result = self.client(5).result()
        assert result["requests"] > 20
        assert result["failed"] == 0, result


class Client:
    """A plain ROS node that asks ten times a second, on another computer of the network."""

    def __init__(self, made: Machine, seconds: float) -> None:
        # What is in another machine's memory cannot be read from here.
        udp = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4", "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
        environ = {**os.environ, **ROS, **udp}
        asks = (str(NODES / "plan_client.py"), str(seconds), "10", "12")
        command = made.outside(sys.executable, *asks)
        self._process = subprocess.Popen(
            command, env=environ, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self._process.stderr is not None
        assert "asking\n" in iter(self._process.stderr.readline, ""), "it found no service"

    def finish(self) -> dict[str, Any]:
        """Let it ask no more; return what became of its requests."""
        self._process.send_signal(signal.SIGINT)
        return self.result()

    def result(self) -> dict[str, Any]:
        """Wait for its end; return what became of its requests."""
        out, err = self._process.communicate(timeout=60)
        assert self._process.returncode == 0, err
        result = json.loads(out)
        print(json.dumps(result))
        assert result["wrong"] == result["twice"] == 0, result
        return result


@pytest.fixture(params=["system", "user"])
def robot(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Robot]:
    with machine(tmp_path / "machine") as made:
        yield Robot(made, system=request.param == "system")


def test_a_pool_goes_on_whatever_dies_and_after_each_boot(robot: Robot) -> None:
    """Taken over from `fogft up` without a loss, then killed, frozen, rebooted and removed."""
    robot.fogft("up", f"{HOME}/pool.yaml", "--yes")
    robot.whole()
    client = robot.client()
    robot.service("install")
    robot.pids()
    robot.serves(*PARTS)
    assert client.finish()["failed"] == 0, "systemd's took over"

    client = robot.client()
    manager = robot.pids()[PARTS[0]]
    robot.signal("KILL", manager)
    robot.pids(without=manager)
    assert client.finish()["failed"] == 0, "a killed manager costs nothing"

    for how in ("KILL", "STOP"):
        serving = robot.serving()
        before = robot.pids()[serving]
        robot.signal(how, before)
        robot.serves(*{*PARTS[1:]} - {serving})
        robot.pids(without=before)
        robot.answers()

    for cut in (False, True):
        client = robot.client()
        booted = robot.machine.init()
        if cut:
            robot.machine.cut_power()
        else:
            robot.machine.run("systemctl", "reboot", "--no-block")
        robot.machine.await_boot(after=booted)
        robot.pids()
        robot.whole()
        client.finish()
        robot.answers()

    robot.service("remove")
    assert robot.systemctl("list-unit-files", "--no-legend", "fogft*") == ""
    assert "service.env" not in robot.machine.run("ls", STATE)
    robot.fogft("up", f"{HOME}/pool.yaml", "--yes")
    robot.whole()
    robot.fogft("down", "--yes")
    left = robot.machine.run("pgrep", "-af", "fogft|plan_service", ok=False)
    assert left == "", left
    # Before, a unit whose cgroup holds the local cloud's machines is not forgotten.
    assert robot.systemctl("list-units", "--all", "--no-legend", "fogft*") == ""


def test_a_gateway_and_a_rendezvous_go_on_whatever_dies_and_after_a_boot(tmp_path: Path) -> None:
    """A rendezvous costs nothing; a lone gateway that is killed or hangs is started again."""
    with machine(tmp_path / "machine") as made:
        robot = Robot(made, system=True)
        robot.write(f"{HOME}/pool.yaml", POOL + BEHIND_A_GATEWAY)
        up = (sys.executable, "-m", "fogft", "up", f"{HOME}/pool.yaml", "--yes", "--timeout", "1")
        robot.fogft(*up[3:], ok=False)  # it answers once there is a gateway
        units = []
        for part, name, listen in (
            ("rendezvous", "meet", MEETING),
            ("gateway", "east", GATEWAY),
        ):
            config = Path(robot.join(part, name, listen))
            robot.service("install", f"--{part}", str(config))
            units.append(f"fogft-{part}-{config.stem}.service")
            wait(lambda: robot.pid(units[-1]), robot.told)
        robot.service("install")
        robot.whole()

        for how in ("KILL", "STOP"):
            for unit in units:
                client = robot.client()
                before = robot.pid(unit)
                robot.signal(how, before)
                wait(lambda u=unit, b=before: robot.pid(u) not in (0, b), robot.told, 240)
                robot.whole()
                failed = client.finish()["failed"]
                assert "gateway" in unit or not failed, (how, unit)
            robot.answers()

        booted = made.init()
        made.run("systemctl", "reboot", "--no-block")
        made.await_boot(after=booted)
        wait(lambda: all(map(robot.pid, units)), robot.told, 240)
        robot.whole()
        robot.answers()
        robot.fogft("down", "--yes")


def test_an_upgrade_hands_the_client_proxy_over_on_an_overlay(tmp_path: Path) -> None:
    """Where the kernel's list of locks knows a file by another device, the lock's file tells."""
    with machine(tmp_path / "machine") as made:
        robot = Robot(made, system=True)
        before = f"{HOME}/before"
        made.run("mkdir", before, user="robot")
        made.run("cp", "-r", f"{ROOT}/fogft", f"{ROOT}/templates", before, user="robot")
        version = f's/"{fogft.__version__}"/"0.0.9"/'
        made.run("sed", "-i", version, f"{before}/fogft/__init__.py", user="robot")
        robot.path(f"{before}:{ROOT}")
        robot.fogft("up", f"{HOME}/pool.yaml", "--yes")
        robot.whole()
        old = json.loads(robot.read("proxy-status.json"))
        assert old["version"] == "0.0.9"
        robot.path(str(ROOT))
        client = robot.client()
        robot.fogft("up", f"{HOME}/pool.yaml", "--yes")

        def new() -> bool:
            report = json.loads(robot.read("proxy-status.json"))
            return bool(report["version"] == fogft.__version__ and report["pid"] != old["pid"])

        wait(new, robot.told)
        assert client.finish()["failed"] == 0
        robot.fogft("down", "--yes")
