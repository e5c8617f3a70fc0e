"""A pool of real proxies and services as processes, without a manager and without a cloud.

The bench writes the proxies' configuration and the membership itself, and so holds every
process by its id. All of them die with the bench.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from fogft import disk
from fogft.model import membership as memberships
from fogft.model.plain import to_plain
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.model.state import FIELD, RESTORE_TYPE, SNAPSHOT_TYPE, StateService, StateSpec
from fogft.model.topic import TopicSpec
from fogft.pool.credentials import authority
from fogft.ros import shared_memory
from fogft.ros.environment import child_environment
from tests.bench.nodes.service import ACTION_SERVICES, FLAG, GRAPH, MAP, SPEAKS, STATEFUL, TOPICS
from tests.fakes.waiting import wait_for
from tests.hostile.orders import HOSTILE
from tests.ports import free_ports
from tests.records import certificate_names

ROOT = Path(__file__).resolve().parents[2]
_READY_LIMIT_S = 60.0
_LIBC = ctypes.CDLL(None)


def free_domains(count: int) -> list[int]:
    """Return ROS domains below 60 (tests use those above) in which nobody listens here."""
    ports = set()
    for table in ("/proc/net/udp", "/proc/net/udp6"):
        with contextlib.suppress(OSError):
            for line in Path(table).read_text().splitlines()[1:]:
                ports.add(int(line.split()[1].rsplit(":", 1)[1], 16))
    free = [d for d in range(1, 60) if not any(0 <= p - 7400 - 250 * d < 250 for p in ports)]
    start = os.getpid() % len(free)
    return (free[start:] + free[:start])[:count]


def _die_with_parent() -> None:
    _LIBC.prctl(1, signal.SIGKILL, 0, 0, 0)


@dataclass
class Replica:
    """One server proxy with its service below it."""

    id: ReplicaId
    domain_id: int
    port: int
    dial_port: int  # the relay's where there is one
    process: subprocess.Popen[bytes]
    relay: subprocess.Popen[bytes] | None = None

    def service_pid(self) -> int:
        """Return the process id of the service."""
        pid = self.process.pid
        return int(Path(f"/proc/{pid}/task/{pid}/children").read_text().split()[0])

    def signal(self, number: int) -> None:
        """Send a signal to server proxy and service, as to a whole machine."""
        pids = [self.process.pid]
        with contextlib.suppress(OSError, IndexError):
            pids.append(self.service_pid())
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)


class Rig:
    """N replicas, one client proxy and the bare round trip's replier. Use as a context manager.

    Args:
        folder: An empty folder of its own.
        replicas: How many.
        sleep_s: How long the service sleeps over each request.
        relayed: Slots that are reached through a relay.
        services: What each slot's service is started with, instead of `sleep_s`.
        replica: More of the `/bench_flag` service for the replicas' configurations.
        policy: More of it for the client proxy's.
        stateful: Whether its services keep state, so that their requests are ordered.
        tell_losers: Whether the client proxy tells replicas what is no longer wanted.
        rmw: How proxies, services and callers speak ROS.
        environ: More of the environment for every process.
        graph: Whether topics and an action pass as well.
        topics: Other topics that pass.
        hostile: Slots of replicas that lie, as their file says (`tests.hostile.serve`).
        bare: Whether the same services are also to be had the barest way, in `bare_domain`.
    """

    def __init__(
        self,
        folder: Path,
        replicas: int,
        *,
        sleep_s: float = 0.0,
        relayed: Sequence[int] = (),
        services: Sequence[str] = (),
        replica: dict[str, Any] | None = None,
        policy: dict[str, Any] | None = None,
        stateful: bool = False,
        tell_losers: bool = True,
        rmw: str = "rclpy",
        environ: Mapping[str, str] = MappingProxyType({}),
        graph: bool = False,
        topics: Sequence[TopicSpec] = (),
        hostile: Mapping[int, Path] = MappingProxyType({}),
        bare: bool = False,
    ) -> None:
        self._folder = folder
        self._hostile = hostile
        self._uid = secrets.token_hex(8)
        self._version = 0
        self._processes: list[subprocess.Popen[bytes]] = []
        self._arguments = services or [str(sleep_s)] * replicas
        self._of_replica = replica or {}
        self._tell_losers = tell_losers
        self._rmw = rmw
        self._environ = environ
        self._action = ACTION_SERVICES if graph else ()
        self._graph = graph
        self._topics = [to_plain(topic) for topic in (*(TOPICS if graph else ()), *topics)]
        self._stateful = stateful
        self._policy: dict[str, Any] = policy or {}
        self.robot_domain, self.bare_domain, *domains = free_domains(2 + 2 * replicas)
        self.domains, self._bare_domains = domains[:replicas], domains[replicas:]
        authority.create_authority(folder / "ca", self._uid)
        self.replicas = [self._replica(slot, slot in relayed) for slot in range(replicas)]
        self.floor_port = self._floor()
        self.proxy = self._client_proxy()
        self._next: subprocess.Popen[bytes] | None = None
        self.bare = self._bare() if bare else []
        self.follow(range(replicas))

    def __enter__(self) -> Rig:
        try:
            self.wait_ready(range(len(self.replicas)))
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def follow(self, slots: Sequence[int]) -> None:
        """Have the client proxy hold links to these slots and no others."""
        self._version += 1
        members = tuple(
            Member(r.id, f"127.0.0.1:{r.dial_port}") for r in self.replicas if r.id.slot in slots
        )
        membership = Membership("bench", self._uid, 1, self._version, members)
        disk.write_json(self._folder / "membership.json", memberships.to_dict(membership))

    def links(self) -> dict[int, dict[str, Any]]:
        """Return the client proxy's links by slot, as it last reported them."""
        report = disk.read_json(self._folder / "proxy-status.json") or {}
        return {link["slot"]: link for link in report.get("links", ())}

    def report(self, after: float = 0.0) -> dict[str, Any]:
        """Return the client proxy's report, one written after this moment (of `time.time`)."""

        def read() -> dict[str, Any]:
            return disk.read_json(self._folder / "proxy-status.json") or {}

        self._wait(lambda: read().get("written_at", 0.0) > after, "the client proxy's report")
        return read()

    def wait_ready(self, slots: Sequence[int]) -> None:
        """Wait until the client proxy holds exactly these links, all up and ready."""

        def ready() -> bool:
            links = self.links()
            every = 2 + len(self._action) + len(self._topics)
            return set(links) == set(slots) and all(
                len(k["ready"]) == every for k in links.values()
            )

        self._wait(ready, f"replicas {list(slots)} to be ready")

    def _wait(self, condition: Callable[[], bool], what: str) -> None:
        def dead() -> list[Any]:
            return [p.args for p in self._processes if p.poll() is not None]

        def told() -> str:
            return f"; ended: {dead()}; logs: {self._folder}\n{self._log()}"

        wait_for(lambda: condition() or dead(), _READY_LIMIT_S, what, told=told, pause_s=0.05)
        if not condition():
            raise RuntimeError(f"waited in vain for {what}{told()}")

    def _log(self) -> str:
        lines = []
        for log in sorted(self._folder.glob("*.log")):
            lines += [f"{log.name}: {line}" for line in log.read_text().splitlines()[-5:]]
        return "\n".join(lines)

    def _replica(self, slot: int, relayed: bool) -> Replica:
        id = ReplicaId(self._uid, slot, 1)
        port, dial_port = free_ports(2)
        name = f"replica-{slot}"
        self._issue(name, "replica", id.certificate_name, authority.Role.REPLICA)
        config = {
            "pool": "bench",
            "pool_uid": self._uid,
            "slot": slot,
            "generation": 1,
            "listen": f"127.0.0.1:{port}",
            "services": self._services(self._of_replica),
            "run": f"exec {sys.executable} -m tests.bench.nodes.service {self._arguments[slot]}",
            "envs": {
                SPEAKS: self._rmw,
                **({STATEFUL: "1"} if self._stateful else {}),
                **({GRAPH: "1"} if self._graph else {}),
            },
            "rmw": self._rmw,
            "topics": self._topics,
            "workdir": str(ROOT),
            "credentials": _pair(name, "replica"),
            "domain_id": self.domains[slot],
        }
        (self._folder / f"{name}.yaml").write_text(json.dumps(config))  # JSON is YAML
        module, environ = "fogft", dict[str, str]()
        if slot in self._hostile:
            module, environ = "tests.hostile.serve", {HOSTILE: str(self._hostile[slot])}
        process = self._start(name, module, "serve", "--config", f"{name}.yaml", environ=environ)
        relay = None
        if relayed:
            relay = self._start(f"relay-{slot}", "tests.bench.relay", str(dial_port), str(port))
        return Replica(id, self.domains[slot], port, dial_port if relayed else port, process, relay)

    def _client_proxy(self) -> subprocess.Popen[bytes]:
        self._issue(
            "robot",
            "robot",
            certificate_names.robot(self._uid, "bench"),
            authority.Role.ROBOT,
        )
        self._write_policy()
        return self._start("proxy", "fogft", "proxy", "--config", "proxy.yaml")

    def put_in_line(self) -> None:
        """Start another client proxy, which takes over when the first ends."""
        self._next = self._start("proxy", "fogft", "proxy", "--standby", "--config", "proxy.yaml")
        log = self._folder / "proxy.log"  # begun anew
        self._wait(lambda: "standby_ready" in log.read_text(), "the one in line")

    def kill_proxy(self) -> float:
        """Kill the client proxy; start another one at once where none is in line. Return when."""
        self._processes.remove(self.proxy)
        self.proxy.kill()
        killed_at = time.monotonic()
        self.proxy.wait()
        if self._next is None:
            self.proxy = self._start("proxy", "fogft", "proxy", "--config", "proxy.yaml")
        else:
            self.proxy, self._next = self._next, None
        return killed_at

    def change(self, **policy: Any) -> None:
        """Give the client proxy another policy for `/bench_flag` while it runs, and wait for it."""
        before = (self._folder / "proxy.log").read_text().count("config_applied")
        self._policy = policy
        self._write_policy()
        log = self._folder / "proxy.log"
        self._wait(lambda: log.read_text().count("config_applied") > before, "the new policy")

    def _write_policy(self) -> None:
        config = {
            "pool": "bench",
            "pool_uid": self._uid,
            "robot": "bench",
            "membership": "membership.json",
            "status": "proxy-status.json",
            "lease": "lease.json",
            "lock": "proxy.lock",
            "credentials": _pair("robot", "robot"),
            "services": self._services(self._policy),
            "topics": self._topics,
            "domain_id": self.robot_domain,
            "tell_losers": self._tell_losers,
            "rmw": self._rmw,
        }
        disk.write_whole(self._folder / "proxy.yaml", json.dumps(config))

    def _floor(self) -> int:
        """Start the bare replier, with certificates like a replica's."""
        (port,) = free_ports(1)
        id = ReplicaId(self._uid, 99, 1)
        folder = self.floor_folder
        for stem, name, role in (
            ("replica", id.certificate_name, authority.Role.REPLICA),
            ("robot", certificate_names.robot(self._uid, "floor"), authority.Role.ROBOT),
        ):
            self._issue(folder.name, stem, name, role)
        self._start("floor", "tests.bench.floor", str(folder), str(port))
        log = self._folder / "floor.log"
        self._wait(lambda: "ready" in log.read_text(), "the bare replier")
        return port

    def _bare(self) -> list[subprocess.Popen[bytes]]:
        """Start services of its own, the replicas' ends, and the robot's, which is the first."""
        ports, domains = free_ports(len(self.domains)), self._bare_domains
        started = []
        for number, (domain, port) in enumerate(zip(domains, ports, strict=True)):
            name = f"bare-service-{number}"
            environ = {"ROS_DOMAIN_ID": str(domain), SPEAKS: self._rmw}
            words = self._arguments[number].split()
            started.append(self._start(name, "tests.bench.nodes.service", *words, environ=environ))
            started.append(self._bare_end(f"bare-{number}", "replica", domain, [port]))
        return [self._bare_end("bare-robot", "robot", self.bare_domain, ports), *started]

    def _bare_end(
        self, name: str, side: str, domain: int, ports: Sequence[int]
    ) -> subprocess.Popen[bytes]:
        words = [side, str(self.floor_folder), str(domain), *map(str, ports)]
        process = self._start(name, "tests.bench.bare", *words)
        log = self._folder / f"{name}.log"
        self._wait(lambda: "ready" in log.read_text(), f"the bare {side}")
        return process

    @property
    def floor_folder(self) -> Path:
        """Where the bare round trip's certificates are."""
        return self._folder / "floor"

    def _issue(self, folder: str, stem: str, name: str, role: authority.Role) -> None:
        credential = authority.issue(self._folder / "ca", name, role=role)
        authority.write(credential, self._folder / folder, stem)

    def _services(self, of_flag: dict[str, Any]) -> list[dict[str, Any]]:
        flag, other = ({"name": n, "type": t, "timeout_s": 10.0} for n, t in (FLAG, MAP))
        services = [{**flag, **of_flag}, other, *map(to_plain, self._action)]
        if self._stateful:
            return [{**s, "state": to_plain(_state(str(s["name"])))} for s in services]
        return services

    def _start(
        self,
        name: str,
        module: str,
        *arguments: str,
        environ: Mapping[str, str] = MappingProxyType({}),
    ) -> subprocess.Popen[bytes]:
        environ = {**child_environment(), "PYTHONPATH": str(ROOT), **self._environ, **environ}
        environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        with (self._folder / f"{name}.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", module, *arguments],
                cwd=self._folder,
                env=environ,
                stdout=log,
                stderr=log,
                preexec_fn=_die_with_parent,
            )
        self._processes.append(process)
        return process

    def close(self) -> None:
        """End every process; remove the shared memory of those that were killed."""
        for process in self._processes:
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGCONT)
                process.terminate()
        for process in self._processes:
            try:
                process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        shared_memory.sweep()


def _state(service: str) -> StateSpec:
    return StateSpec(
        StateService(f"{service}/get_state", SNAPSHOT_TYPE, FIELD),
        StateService(f"{service}/set_state", RESTORE_TYPE, FIELD),
    )


def _pair(folder: str, stem: str) -> dict[str, str]:
    return {
        "ca": f"{folder}/ca.crt",
        "certificate": f"{folder}/{stem}.crt",
        "key": f"{folder}/{stem}.key",
    }
