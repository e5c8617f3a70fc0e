"""A SkyPilot API server elsewhere does what the local one does, for a robot without credentials.

Unmodified SkyPilot, its real API server as a process with its own home, AWS's interface under
moto; all on loopback.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.fakes import waiting
from tests.needs import needs
from tests.ports import free_port

HERE = Path(__file__).parent
WITHIN_S = 300.0  # a busy machine takes minutes to start an API server
pytestmark = [needs("skypilot", "moto", "skypilot-port"), pytest.mark.timeout(900)]


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    return waiting.wait_for(condition, WITHIN_S, what, pause_s=0.2)


class World:
    """The emulated AWS, the API server, and the homes of server and robot."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.started: list[subprocess.Popen[Any]] = []
        self.aws = f"http://127.0.0.1:{(port := free_port())}"
        self._start("aws", [str(HERE / "loopback_aws.py"), str(port)], dict(os.environ))
        wait_for(lambda: "ready" in self.log("aws"), "AWS's interface")
        self.endpoint = f"http://127.0.0.1:{(port := free_port())}"
        metrics = free_port()
        self._start(
            "server",
            ["-m", "sky.server.server", f"--port={port}", f"--metrics-port={metrics}"],
            self.environ("server", AWS_ENDPOINT_URL=self.aws, IS_SKYPILOT_SERVER="true"),
        )
        wait_for(self._answers, "SkyPilot's API server")

    def _tools(self) -> str:
        """Return a folder with what SkyPilot insists on and this machine lacks."""
        folder = self.folder / "tools"
        folder.mkdir(exist_ok=True)
        for name in ("rsync", "ssh"):
            if shutil.which(name) is None:
                (folder / name).write_text("#!/bin/sh\n[ $# = 1 ]  # only its version is asked\n")
                (folder / name).chmod(0o755)
        return str(folder)

    def environ(self, whose: str, **more: str) -> dict[str, str]:
        """Return an environment with a home of its own, and no credentials of this user's."""
        home = self.folder / whose
        if not home.exists():
            made = [sys.executable, str(HERE / "emulated_aws" / "home.py"), str(home)]
            subprocess.run(made, check=True, timeout=60)
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("AWS_", "SKYPILOT_"))}
        return {
            **kept,
            "HOME": str(home),
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}:{self._tools()}",
            "SKYPILOT_DISABLE_USAGE_COLLECTION": "1",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_EC2_METADATA_DISABLED": "true",
            "PYTHONPATH": str(HERE.parents[1]),
            **more,
        }

    def robot(self) -> subprocess.Popen[Any]:
        """Start a robot that has no credentials, and may start no API server."""
        environ = self.environ(
            "robot",
            SKYPILOT_API_SERVER_ENDPOINT=self.endpoint,
            SKYPILOT_DISABLE_LOCAL_API_SERVER="1",
            AWS_ENDPOINT_URL=self.aws,
        )
        shutil.rmtree(self.folder / "robot" / ".aws")
        return self._start("client", [str(HERE / "remote_client.py"), str(self.folder)], environ)

    def instances(self) -> list[str]:
        """Return the state of every instance that the provider knows, by name."""
        import boto3

        ec2 = boto3.client(
            "ec2", region_name="us-east-1", endpoint_url=self.aws,
            aws_access_key_id="test", aws_secret_access_key="test",
        )  # fmt: skip
        found = ec2.describe_instances()["Reservations"]
        return [i["State"]["Name"] for r in found for i in r["Instances"]]

    def log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    def _answers(self) -> bool:
        try:
            with urllib.request.urlopen(f"{self.endpoint}/api/health", timeout=5) as answer:
                return bool(answer.status == 200)
        except OSError:
            assert self.started[-1].poll() is None, self.log("server")[-3000:]
            return False

    def _start(self, name: str, words: list[str], environ: dict[str, str]) -> subprocess.Popen[Any]:
        with (self.folder / f"{name}.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, *words], env=environ, cwd=self.folder, stdout=log, stderr=log,
                start_new_session=True,
            )  # fmt: skip
        self.started.append(process)
        return process

    def close(self) -> None:
        for process in self.started:
            process.kill()
            process.wait()
        while left := self._workers():  # the API server's, each in a session of its own
            for pid, command in left.items():
                # Python's tracker ends after all others, and removes their semaphores.
                if b"resource_tracker" not in command:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
            time.sleep(0.05)

    def _workers(self) -> dict[int, bytes]:
        """Find what was started in our folder and lives; SkyPilot overwrites all else of it."""
        found = {}
        for entry in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if Path(os.readlink(entry / "cwd")).is_relative_to(self.folder):
                    found[int(entry.name)] = (entry / "cmdline").read_bytes()
        return found


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    made = World.__new__(World)
    made.started = []
    try:
        made.__init__(tmp_path)  # type: ignore[misc]
        yield made
    finally:
        made.close()


def test_a_robot_without_credentials_launches_and_ends_through_a_server_elsewhere(world: World):
    """Credentials tested, prices told, a VM launched with its files, aborted and ended."""
    robot = world.robot()
    wait_for(lambda: (world.folder / "launched").exists() or robot.poll() is not None, "the order")
    assert robot.poll() is None, world.log("client")[-4000:]
    wait_for(
        lambda: "running" in world.instances() or "launch_failed" in world.log("client"),
        "the VM at the provider",
    )
    assert "running" in world.instances(), world.log("client")[-4000:]
    (world.folder / "seen").touch()
    assert robot.wait(WITHIN_S) == 0, world.log("client")[-4000:]
    told = json.loads(world.log("client").splitlines()[-1])
    assert told["check"] == {"aws": ""}
    assert {(place.split("/")[1], kind, source) for place, kind, source in told["offers"]} == {
        ("us-east-1", "m6i.large", "catalogue")
    }
    assert told["listed"] == [["0.1", "provisioning"]]
    assert told["before"] == ["provisioning", None]
    assert told["after"] == []
    assert told["audit"] == [[], []], "nobody but SkyPilot could be asked"
    assert "relies on SkyPilot's list" in told["unverified"], "and `up` says so"
    assert set(world.instances()) == {"terminated"}
