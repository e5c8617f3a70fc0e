"""A robot as a process of its own, which asks one replica so much and then does nothing more.

Argument: JSON, see `RobotProcess`.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

from fogft.link.zenoh.robot.dialer import ZenohDialer
from fogft.link.zenoh.settings import LinkSettings
from fogft.model.credentials import CredentialPaths
from tests.link.wire_pool import (
    POOL_UID,
    SERVICE,
    Authority,
    Owner,
    ReplicaProcess,
    keys,
    peer,
    request_id,
    wait_for,
)


class RobotProcess:
    """Starts a robot, and returns when it has offered so many requests of this payload."""

    def __init__(
        self,
        authority: Authority,
        replica: ReplicaProcess,
        *,
        requests: int,
        payload: str,
        settings: LinkSettings,
    ) -> None:
        files = authority.robot("other")
        arguments = {
            "files": [str(files.ca), str(files.certificate), str(files.key)],
            "endpoint": replica.endpoint,
            "settings": asdict(settings),
            "requests": requests,
            "payload": payload,
        }
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.link.zenoh.robot_process", json.dumps(arguments)],
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parents[3],
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "offered\n"

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


def main() -> None:
    given = json.loads(sys.argv[1])
    files = CredentialPaths(*(Path(path) for path in given["files"]))
    owner, settings = Owner(), LinkSettings(**given["settings"])
    dialer = ZenohDialer(files, robot="other", pool_uid=POOL_UID, settings=settings)
    link = dialer.dial(peer(given["endpoint"]), keys(0), owner)
    wait_for(lambda: link.usable)
    for number in range(given["requests"]):
        link.offer(SERVICE, request_id(number), given["payload"].encode(), 600.0)
    print("offered", flush=True)
    signal.pause()


if __name__ == "__main__":
    main()
