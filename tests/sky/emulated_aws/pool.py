"""A pool inside a world, driven through the command line, and what is looked at of it."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml

from tests.e2e.pool import NODES
from tests.sky.emulated_aws.emulation import running, until

ROBOT = Path("/robot")
HOME = ROBOT / "fogft"
UP_WITHIN_S = 900.0  # a busy machine takes minutes for what a quiet one does in one


class Pool:
    """One pool, as a user at the command line has it.

    Args:
        text: Its pool file.
    """

    def __init__(self, text: str) -> None:
        self.name = str(yaml.safe_load(text)["name"])
        self.folder = ROBOT / self.name
        self.folder.mkdir(parents=True)
        self.file = self.folder / "pool.yaml"
        self.file.write_text(text)
        shutil.copy(NODES / "plan_service.py", self.folder)
        self.environ = {
            **os.environ,
            "FOGFT_HOME": str(HOME),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(ROBOT / "ros-log"),
            "NO_COLOR": "1",
        }

    def stop_sky(self) -> None:
        """Stop SkyPilot's API server, which commands have started where they needed it."""
        done = subprocess.run(
            ["sky", "api", "stop"], env=self.environ, text=True, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=UP_WITHIN_S, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout

    def leave_nothing(self) -> None:
        """Stop the API server, and wait until no process of any pool runs here."""
        self.stop_sky()
        try:
            until("nothing of it runs here", lambda: not processes(), 60)
        except AssertionError:
            print("still running:", *processes(), sep="\n  ")
            raise

    def fogft(self, *words: str, status: int = 0, limit_s: float = UP_WITHIN_S) -> str:
        """Run a command; return all that it said."""
        done = subprocess.run(
            [sys.executable, "-m", "fogft", *words], env=self.environ, cwd=self.folder, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
            timeout=limit_s, check=False,
        )  # fmt: skip
        assert done.returncode == status, f"fogft {' '.join(words)}\n{done.stdout}"
        return done.stdout

    def down(self) -> None:
        """End it; again where SkyPilot's server, just started, does not answer in time."""

        def ended() -> bool:
            try:
                print(self.fogft("down", self.name))
            except AssertionError as error:
                if "run `fogft down" not in str(error):
                    raise
                print(error)
                return False
            return True

        until("`down` has ended it", ended, UP_WITHIN_S)

    @property
    def state(self) -> Path:
        """The folder of its state; there while it is up."""
        return HOME / "pools" / self.name

    def status(self) -> dict[str, Any]:
        """Return `status.json`, as the manager wrote it last."""
        return json.loads((self.state / "status.json").read_text())

    def replicas(self, phase: str = "ready") -> dict[str, dict[str, Any]]:
        """Return the replicas in a phase, by ``slot.generation``."""
        found = self.status()["replicas"]
        return {f"{r['slot']}.{r['generation']}": r for r in found if r["phase"] == phase}

    def others(self, name: str) -> set[str]:
        """Return the replicas of any phase but the one named."""
        return {f"{r['slot']}.{r['generation']}" for r in self.status()["replicas"]} - {name}

    def clusters(self) -> set[str]:
        """Return the names of the replicas' clusters."""
        status = self.status()
        return {f"fogft-{status['uid']}-{r['slot']}-{r['generation']}" for r in status["replicas"]}

    def whole(self, count: int) -> bool:
        """Whether that many replicas are ready, and there is no other."""
        status = self.status()
        return status["ready"] == count == len(status["replicas"])

    def pid(self, part: str) -> int:
        return int(self.status()[f"{part}_pid"])

    def keep_log(self) -> None:
        """Copy the manager's log to the results, since `down` removes it."""
        log = self.state / "manager.log"
        if log.exists():
            shutil.copy(log, Path(os.environ["RESULTS"]) / f"{self.name}-manager.log")


def region_of(replica: dict[str, Any]) -> str:
    return str(replica["location"].split("/")[1])


def machine_of(name: str) -> dict[str, Any]:
    """Return the instance of a replica, ``slot.generation``."""
    slot, generation = name.split(".")
    wanted = {"fogft-slot": slot, "fogft-generation": generation}
    return next(i for i in running() if wanted.items() <= i["labels"].items())


def open_ports(region: str, name: str) -> set[int]:
    """Return the ports that security groups open to the world, by how their names begin.

    By name, since the emulation does not tell which groups a machine is in.
    """
    import boto3

    found = boto3.client("ec2", region_name=region).describe_security_groups()["SecurityGroups"]
    groups = [group for group in found if group["GroupName"].startswith(name)]
    assert groups, [group["GroupName"] for group in found]
    return {
        port
        for group in groups
        for rule in group["IpPermissions"]
        for port in range(rule.get("FromPort", 0), rule.get("ToPort", 65535) + 1)
        if rule["IpRanges"] or rule["Ipv6Ranges"]
    }


def reaches(host: str, port: int, source: str = "") -> bool:
    """Whether a port of a VM answers, to one of this computer's addresses."""
    with socket.socket() as one:
        one.settimeout(5)
        one.bind((source, 0))
        return one.connect_ex((host, port)) == 0


def process_on(machine: dict[str, Any], word: str) -> str:
    """Return, as it is seen from here, a process on a VM whose command line has some word."""
    words = ["ip", "netns", "pids", f"f{machine['id'][-8:]}"]
    pids = subprocess.run(words, check=True, capture_output=True, text=True).stdout.split()
    return next(p for p in pids if word in Path(f"/proc/{p}/cmdline").read_text())


def clusters() -> set[str]:
    """Return the clusters that SkyPilot has a record of."""
    from sky.client import sdk

    return {record["name"] for record in sdk.get(sdk.status(None, all_users=True))}


def processes() -> list[str]:
    """Return the command line of every process here that descends from one of the pool's."""
    mark, found = f"FOGFT_HOME={HOME}\0".encode(), []
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and mark in (entry / "environ").read_bytes():
                found.append((entry / "cmdline").read_bytes().replace(b"\0", b" ").decode())
        except OSError:
            continue
    return found


def servers_of_sky() -> list[Any]:
    """Return the processes of SkyPilot's API server, with all that it has started."""
    import psutil

    servers = [
        process
        for process in psutil.process_iter(["cmdline"])
        if "sky.server.server" in " ".join(process.info["cmdline"] or ())
    ]
    assert servers
    return [*servers, *(c for s in servers for c in s.children(recursive=True))]


def kill_server() -> None:
    """Kill SkyPilot's API server with all that it has started, as when a robot's power is cut."""
    import psutil

    for process in servers_of_sky():
        try:
            process.kill()
        except psutil.NoSuchProcess:
            continue
