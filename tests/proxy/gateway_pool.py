"""Gateways, echoing replicas and robots without ROS as processes; the test is the manager."""

from __future__ import annotations

import contextlib
import json
import os
import struct
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from fogft.child import tied
from fogft.model import membership
from fogft.model.credentials import CredentialPaths, Role
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.model.topology import Gateway, RobotRoute, Topology
from tests.link import forked
from tests.link.namespaces import inside
from tests.link.wire_pool import POOL_UID, SERVICE, TYPE, Authority, ReplicaProcess, wait_for
from tests.ports import free_port
from tests.records import certificate_names

ROOT = Path(__file__).parents[2]


class GatewayPool:
    """A pool of processes that talk to each other as a topology says.

    Args:
        timeout_s: Of its only service.
        services: Further keys of that service, as in a configuration file.
    """

    def __init__(self, folder: Path, *, timeout_s: float = 30.0, services: str = "") -> None:
        self.authority = Authority(folder)
        self.folder = folder
        self._service = f"{{name: {SERVICE}, type: {TYPE}, timeout_s: {timeout_s}{services}}}"
        self._version = 1
        self._files: list[Path] = []
        self.members: dict[int, Member] = {}
        self.topology = Topology()
        self.processes: list[Process] = []
        self.replicas: dict[int, ReplicaProcess] = {}

    def replica(self, slot: int, *, where: str = "", host: str = "127.0.0.1", **given: Any) -> None:
        """Start an echoing replica and let it in."""
        endpoint = f"{host}:{free_port() if not where else 7447 + slot}"
        with _inside(where):
            made = ReplicaProcess(
                self.authority.replica(slot), endpoint=endpoint, slot=slot, **given
            )
        self.replicas[slot] = made
        self.members[slot] = Member(ReplicaId(POOL_UID, slot, 1), endpoint)

    def server_proxy(
        self, slot: int, *, where: str = "", host: str = "127.0.0.1", delay_s: float = 0.0
    ) -> subprocess.Popen[bytes]:
        """Start a whole server proxy, which runs a request once, and let it in; to be killed."""
        id = ReplicaId(POOL_UID, slot, 1)
        endpoint = f"{host}:{free_port() if not where else 7447 + slot}"
        self.members[slot] = Member(id, endpoint)
        with _inside(where):
            return start_server(self.folder, self.authority, id, endpoint, delay_s)

    def endpoint(self, slot: int) -> str:
        return self.members[slot].endpoint

    def reach(self, slot: int, endpoint: str) -> None:
        """Have everybody reach a replica at another address, from the next membership on."""
        self.members[slot] = replace(self.members[slot], endpoint=endpoint)

    def forget(self, slot: int) -> None:
        """Let a replica in no more; it was killed."""
        self.replicas.pop(slot).kill()
        del self.members[slot]

    def gateway(
        self, name: str, *, listen: str = "", where: str = "", generation: int = 1, extra: str = ""
    ) -> Process:
        common_name = certificate_names.gateway(POOL_UID, name, generation)
        return Process(
            self, name, "gateway", self.authority.issue(common_name, Role.GATEWAY),
            extra=f"listen: {listen or f'127.0.0.1:{free_port()}'}\n{extra}", where=where,
        )  # fmt: skip

    def robot(self, name: str, *, where: str = "", extra: str = "", first: int = 1) -> Robot:
        """Start a robot; `first` is the number of its first request."""
        return Robot(
            self, name, "robot", self.authority.robot(name), extra=extra, where=where, first=first
        )

    def lay_out(
        self,
        gateways: Mapping[str, tuple[str, Sequence[str]]],
        robots: Mapping[str, Sequence[str]],
        *,
        generations: tuple[int, ...] = (1,),
    ) -> None:
        """Tell everybody the topology: gateway -> endpoint and what it goes through."""
        self.topology = Topology(
            tuple(Gateway(n, at, tuple(ups), generations) for n, (at, ups) in gateways.items()),
            tuple(RobotRoute(name, tuple(through)) for name, through in robots.items()),
        )
        self.publish()

    def publish(self) -> None:
        """Write the membership for everybody."""
        self._version += 1
        members = tuple(self.members.values())
        for path in self._files:
            self.write_membership(path, members)

    def write_membership(self, path: Path, members: tuple[Member, ...] | None = None) -> None:
        members = tuple(self.members.values()) if members is None else members
        wanted = Membership("p", POOL_UID, 1, self._version, members, topology=self.topology)
        new = path.with_suffix(".new")
        new.write_text(json.dumps(membership.to_dict(wanted)))
        os.replace(new, path)

    def config(self, stem: str, role: str, files: CredentialPaths, extra: str) -> Path:
        path = self.folder / f"{stem}.yaml"
        members = self.folder / f"{stem}-members.json"
        self._files.append(members)
        path.write_text(
            f'pool: p\npool_uid: "{POOL_UID}"\nrobot: {stem}\nmembership: {members.name}\n'
            f"status: {stem}-status.json\nlease: lease.json\nlock: {stem}.lock\n"
            f"credentials: {{ca: {files.ca}, certificate: {files.certificate}, "
            f"key: {files.key}}}\nservices: [{self._service}]\n{extra}"
        )
        self.write_membership(members)
        return path

    def ran(self) -> int:
        """Return how many requests reached replicas."""
        return sum(replica.count("requests") for replica in self.replicas.values())

    def close(self) -> None:
        for process in self.processes:
            process.kill()
        for replica in self.replicas.values():
            replica.kill()


class Process:
    """A gateway's process."""

    def __init__(
        self, pool: GatewayPool, name: str, role: str, files: CredentialPaths, *,
        extra: str, where: str, first: int = 1,
    ) -> None:  # fmt: skip
        self._first = first
        self.name = name
        self.files = files
        self._where = where
        self._log = pool.folder / f"{name}.log"
        self._status = pool.folder / f"{name}-status.json"
        self._config = pool.config(name, role, files, extra)
        pool.processes.append(self)
        self.start()

    def start(self) -> None:
        words = ("gateway", "--config", str(self._config))
        with _inside(self._where), self._log.open("ab") as log:
            self.process = forked.start("tests.records.part", *words, stderr=log.fileno())

    def report(self) -> dict[str, Any]:
        try:
            return dict(json.loads(self._status.read_text()))
        except FileNotFoundError:
            return {}

    def endpoint(self) -> str:
        """Return where it listens, once it does."""
        wait_for(lambda: self.report().get("endpoint") or self.process.poll() is not None)
        assert self.process.poll() is None, self._log.read_text()
        return str(self.report()["endpoint"])

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                stream.close()


class ServerProxy:
    """A server proxy without ROS, whose service echoes; see `plain_replica`.

    Args:
        pool: Whose.
        slot: Its slot.
        extra: Further lines of its configuration.
        generation: Its launch.
    """

    def __init__(
        self, pool: GatewayPool, slot: int, extra: str = "", *, generation: int = 1
    ) -> None:
        self.endpoint = f"127.0.0.1:{free_port()}"
        stem = f"replica{slot}.{generation}"
        self._log = pool.folder / f"{stem}.log"
        self._config = pool.folder / f"{stem}.yaml"
        files = pool.authority.replica(slot, generation)
        self._config.write_text(
            f'pool: p\npool_uid: "{POOL_UID}"\nslot: {slot}\ngeneration: {generation}\n'
            f"listen: {self.endpoint}\nadvertise: {self.endpoint}\nnotice: none\n"
            f"services: [{{name: {SERVICE}, type: {TYPE}}}]\nrun: 0 {pool.folder / 'ran'}\n{extra}"
            f"credentials: {{ca: {files.ca}, certificate: {files.certificate}, key: {files.key}}}\n"
        )
        self.start()

    def start(self) -> None:
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(
                tied([sys.executable, "-m", "tests.proxy.plain_replica", str(self._config)]),
                cwd=ROOT, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


class Robot(Process):
    """A client proxy without ROS; see `plain_robot`."""

    def start(self) -> None:
        with _inside(self._where), self._log.open("ab") as log:
            given = (str(self._config), str(self._first))
            name = "tests.proxy.robot.plain_robot"
            self.process = forked.start(name, *given, stderr=log.fileno())

    def tell(self, **command: Any) -> dict[str, Any]:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        assert line, self._log.read_text()
        return dict(json.loads(line))

    def ready(self, count: int = 1) -> bool:
        """Whether so many gateways, or replicas, answer it, and it serves."""
        told = self.tell()
        report = told["report"]
        up = [one for one in report["gateways"] or report["links"] if one["ready"]]
        return len(up) >= count and bool(told["services"])

    def ask(self, count: int, size: int = 8) -> None:
        self.tell(ask=count, bytes=size)

    def all_right(self) -> None:
        """Wait until each request has its own answer, once."""
        wait_for(lambda: (told := self.tell())["right"] == told["asked"] or told["wrong"])
        assert not self.tell()["wrong"]

    def settle(self) -> None:
        """Wait until nothing is pending: what was to be cancelled has been."""
        wait_for(lambda: self.tell()["report"]["services"][SERVICE]["pending"] == 0)

    def sent(self) -> int:
        """Return how many copies of requests it has sent."""
        return int(self.tell()["report"]["services"][SERVICE]["sent"])


def start_server(
    folder: Path, authority: Authority, id: ReplicaId, listen: str, delay_s: float, extra: str = ""
) -> subprocess.Popen[bytes]:
    """Start a server proxy without ROS; see `plain_replica` for what it answers and notes."""
    files, stem = authority.replica(id.slot, id.generation), f"replica{id.slot}.{id.generation}"
    config = folder / f"{stem}.yaml"
    config.write_text(
        f'pool: p\npool_uid: "{POOL_UID}"\nslot: {id.slot}\ngeneration: {id.generation}\n'
        f"listen: {listen}\nnotice: none\nservices: [{{name: {SERVICE}, type: {TYPE}}}]\n"
        f"run: {delay_s} {folder / 'ran'}.{stem}\n{extra}"
        f"credentials: {{ca: {files.ca}, certificate: {files.certificate}, key: {files.key}}}\n"
    )
    with (folder / f"{stem}.log").open("ab") as log:
        return subprocess.Popen(
            tied([sys.executable, "-m", "tests.proxy.plain_replica", str(config)]),
            cwd=ROOT, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
        )  # fmt: skip


def ran(folder: Path) -> dict[str, Counter[int]]:
    """Return how often each server proxy ran which request, by the name of what it noted."""
    noted = {path.name: path.read_bytes() for path in sorted(folder.glob("ran.*"))}
    return {
        name: Counter(n for (n,) in struct.iter_unpack(">Q", whole[: len(whole) // 8 * 8]))
        for name, whole in noted.items()
    }


def _inside(where: str) -> contextlib.AbstractContextManager[None]:
    return inside(where) if where else contextlib.nullcontext()
