"""Server proxies and client proxies as processes, started by hand: no manager, no cloud."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from fogft.model import membership
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.model.topology import Topology
from fogft.pool.credentials import authority
from tests.fakes import waiting
from tests.link import forked
from tests.ports import free_port
from tests.records import certificate_names

UID = "0123456789abcdef"
LIMIT_S = 60.0
ROOT = Path(__file__).parents[2]
SERVICE = ROOT / "tests/e2e/nodes/plan_service.py"
READ_EARLY = {"LD_PRELOAD", "LD_LIBRARY_PATH", "PYTHONPATH"}  # before what is forked has them
Process = subprocess.Popen[bytes] | forked.Forked
SERVICES = "[{name: /plan, type: nav_msgs/srv/GetPlan, timeout_s: 45.0}]"


def wait_for(condition: Callable[[], Any], what: str, limit_s: float = LIMIT_S) -> Any:
    """Return what a condition gave once it holds."""
    return waiting.wait_for(condition, limit_s, what)


class Parts:
    """A pool without a manager: its folder, its certificates and its processes.

    Args:
        services: As a configuration file has them.
        node: What a replica runs, with an argument.

    Attributes:
        tree: Where the fogft lies by which what is started from now on runs.
    """

    def __init__(
        self,
        folder: Path,
        domain: Callable[[], int],
        *,
        services: str = SERVICES,
        node: Path = SERVICE,
    ) -> None:
        self.services, self.node = services, node
        self.folder = folder
        self.tree = ROOT
        self._domain = domain
        self._processes: list[Process] = []
        self._version = 0
        authority.create_authority(folder / "ca", UID)

    def replica(self, slot: int, argument: float | str = 0.001, **environ: str) -> Replica:
        return Replica(self, slot, argument, environ)

    def robot(self, name: str, *replicas: Replica) -> Robot:
        return Robot(self, name, replicas)

    def issue(self, common_name: str, role: authority.Role, stem: str) -> None:
        made = authority.issue(self.folder / "ca", common_name, role=role)
        authority.write(made, self.folder, stem)

    def domain(self) -> int:
        return self._domain()

    def start(
        self, command: str, config: Path, environ: Mapping[str, str] = {}, *options: str
    ) -> Process:
        """Start a part; forked from what has imported it, if it is of this tree."""
        path = os.pathsep.join(filter(None, [str(self.tree), os.environ.get("PYTHONPATH")]))
        words = [command, "--config", str(config), *options]
        env = {**os.environ, "PYTHONPATH": path, **environ}
        process: Process
        with config.with_suffix(".log").open("ab") as log:
            if self.tree == ROOT and not environ.keys() & READ_EARLY:
                given = json.dumps([words, env, str(ROOT)])
                process = forked.Forked("tests.proxy.part", [given], log.fileno())
                process.stdin.close()
                process.stdout.close()
            else:
                process = subprocess.Popen(
                    [sys.executable, "-m", "fogft", *words],
                    cwd=self.tree, stdout=log, stderr=log, env=env,
                )  # fmt: skip
        self._processes.append(process)
        return process

    def next_version(self) -> int:
        self._version += 1
        return self._version

    def close(self) -> None:
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.wait()


class Replica:
    """A server proxy with an ordinary service under it."""

    def __init__(
        self, parts: Parts, slot: int, argument: float | str, environ: Mapping[str, str],
        *, generation: int = 1, extra: str = "",
    ) -> None:  # fmt: skip
        self.id = ReplicaId(UID, slot, generation)
        stem = f"r{slot}.{generation}"
        self._node = parts.node
        self.domain = parts.domain()
        self.endpoint = f"127.0.0.1:{free_port()}"
        parts.issue(self.id.certificate_name, authority.Role.REPLICA, stem)
        config = parts.folder / f"replica{slot}.{generation}.yaml"
        notice = "auto" if environ else "none"
        config.write_text(
            f'pool: p\npool_uid: "{UID}"\nslot: {slot}\ngeneration: {generation}\n'
            f"listen: {self.endpoint}\nservices: {parts.services}\ndomain_id: {self.domain}\n"
            f"run: exec {sys.executable} {parts.node} {argument}\n"
            f"notice: {notice}\n"
            f"credentials: {{ca: ca/ca.crt, certificate: {stem}.crt, key: {stem}.key}}\n{extra}"
        )
        self.log = config.with_suffix(".log")
        self._start = lambda: parts.start("serve", config, environ)
        self.process = self._start()

    def start_again(self) -> None:
        """Start a killed one anew, as the same replica."""
        self.process.wait()
        self.process = self._start()

    def run_pid(self) -> int:
        """Return the process id of the user's command."""
        return int(wait_for(self.run_pids, "the user's command")[0])

    def run_pids(self) -> list[int]:
        """Return the process ids of the user's command, which is started."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        found = []
        for pid in children.read_text().split():
            with contextlib.suppress(OSError):  # it has just ended
                if self._node.name.encode() in Path(f"/proc/{pid}/cmdline").read_bytes():
                    found.append(int(pid))
        return found


class Robot:
    """A client proxy."""

    def __init__(
        self, parts: Parts, name: str, replicas: tuple[Replica, ...], extra: str = ""
    ) -> None:
        self._parts = parts
        self._members = parts.folder / f"{name}-members.json"
        self._status = parts.folder / f"{name}-status.json"
        self.config = parts.folder / f"{name}.yaml"
        self.domain = parts.domain()
        parts.issue(certificate_names.robot(UID, name), authority.Role.ROBOT, name)
        self.config.write_text(
            f'pool: p\npool_uid: "{UID}"\nrobot: {name}\nmembership: {self._members.name}\n'
            f"status: {self._status.name}\nlock: {name}.lock\n"
            f"credentials: {{ca: ca/ca.crt, certificate: {name}.crt, key: {name}.key}}\n"
            f"services: {parts.services}\ndomain_id: {self.domain}\n{extra}"
        )
        if replicas:
            self.follow(*replicas)
        self.process = parts.start("proxy", self.config)

    def follow(self, *replicas: Replica, topology: Topology | None = None) -> None:
        """Write the membership, whole, as a manager would."""
        members = tuple(Member(r.id, r.endpoint) for r in replicas)
        wanted = Membership(
            "p", UID, 1, self._parts.next_version(), members, topology=topology or Topology()
        )
        new = self._members.with_suffix(".new")
        new.write_text(json.dumps(membership.to_dict(wanted)))
        os.replace(new, self._members)

    def restart(self) -> None:
        self.kill()
        self.process = self._parts.start("proxy", self.config)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        self._status.unlink()

    def start_standby(self) -> Process:
        """Start another one that takes over, and wait until it could."""
        log = self.config.with_suffix(".log")
        ready = log.read_text().count("standby_ready")
        process = self._parts.start("proxy", self.config, {}, "--standby")
        wait_for(lambda: log.read_text().count("standby_ready") > ready, "the standby")
        return process

    def report(self) -> dict[str, Any]:
        try:
            return dict(json.loads(self._status.read_text()))
        except FileNotFoundError:
            return {}

    def news(self) -> dict[str, Any]:
        """Return a report that was begun after this call: the next but one."""
        for _ in range(2):
            last = self.report().get("written_at")
            wait_for(lambda: self.report().get("written_at") != last, "a new report")  # noqa: B023
        return self.report()

    def links(self) -> list[dict[str, Any]]:
        return list(self.report().get("links", []))

    def told(self) -> str:
        """Return what it and its replicas have logged lately, for a failure's message."""
        logs = sorted(self._parts.folder.glob("*.log"))
        return "\n".join(f"{log.name}: ...{log.read_text()[-4000:]}" for log in logs)

    def ready(self) -> list[int]:
        """Return the slots that can answer now."""
        return [link["slot"] for link in self.links() if link["ready"]]


class Caller:
    """An rclpy client that checks what it is answered.

    It keeps all answers: one with the default quality of service would lose some whenever a
    busy machine holds it up (`fogft.ros.pacing` makes that rare, and its tests say how rare).
    """

    def __init__(self, domain: int) -> None:
        import rclpy
        from nav_msgs.srv import GetPlan
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import HistoryPolicy, QoSProfile

        self._type = GetPlan
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node("caller", context=self._context)
        keeps_all = QoSProfile(history=HistoryPolicy.KEEP_ALL)
        self._client = self._node.create_client(GetPlan, "/plan", qos_profile=keeps_all)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._asked = 0
        self._open: set[int] = set()
        self._early: set[int] = set()  # asked before the service was known to answer
        self.right = 0
        self.wrong: list[int] = []

    def poison(self) -> None:
        """Send a request of which the service dies; nobody waits for its answer."""
        self._client.call_async(self._type.Request(tolerance=-1.0))

    def ask(self, count: int = 1) -> None:
        """Ask, all at once; nothing is taken meanwhile."""
        for _ in range(count):
            self._asked += 1
            number = self._asked
            request = self._type.Request(tolerance=float(number))
            request.start.pose.position.x = float(number)
            self._open.add(number)
            future = self._client.call_async(request)
            future.add_done_callback(lambda done, number=number: self._answered(number, done))

    def _answered(self, number: int, future: Any) -> None:
        plan = future.result().plan
        once = number in self._open | self._early
        self._open.discard(number)
        self._early.discard(number)
        if once and plan.header.frame_id == f"{number}" and plan.poses[0].pose.position.x == number:
            self.right += 1
        else:
            self.wrong.append(number)

    def spin(self, seconds: float = 0.0) -> None:
        end = time.monotonic() + seconds
        self._executor.spin_once(timeout_sec=seconds)
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def wait(self) -> None:
        """Wait until the service is there and has answered, which a dead one does not."""
        assert self._client.wait_for_service(timeout_sec=LIMIT_S)
        before, end = self.right, time.monotonic() + LIMIT_S
        while self.right == before:
            assert time.monotonic() < end, "the service never answered"
            self.ask()
            self.spin(0.5)
        self._early |= self._open  # they may be answered late, or never
        self._open.clear()

    def all_answered(self, limit_s: float = LIMIT_S) -> bool:
        """Take answers until each request has its own; whether that came about."""
        end = time.monotonic() + limit_s
        while self._open and time.monotonic() < end:
            self.spin(0.05)
        if self._open or self.wrong:
            asked = f"{self._asked} asked, {self.right} right"
            print(f"{asked}, unanswered: {sorted(self._open)}, wrong: {self.wrong}")
        return not self._open and not self.wrong

    def servers(self) -> int:
        """Count who serves, as discovery has it."""
        return len(self._node.get_subscriptions_info_by_topic("rq/planRequest", no_mangle=True))

    def close(self) -> None:
        self._node.destroy_node()
        self._context.try_shutdown()
