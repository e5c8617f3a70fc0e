"""A robot with an arm64 processor, emulated by QEMU, and replicas with x86_64 processors.

`scripts/test-arm64` makes the robot: a Debian for arm64 in a folder, in which fogft was installed
from its wheel, with no ROS.
"""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from tests.e2e.pool import Machine, Pool
from tests.needs import need
from tests.rmw_zenoh.rmw_router import Router

need("pyzeros")
need("arm64")
pytestmark = [pytest.mark.e2e, pytest.mark.timeout(600)]

NODE = Path(__file__).parents[1] / "proxy/nodes/echo_over_zenoh.py"
REQUESTS = 1000
AT_ONCE = 20
# Mounts of its own end with the process: nothing of this machine is left mounted in the folder.
_ENTER = """
for shared in /proc /dev "$2"; do
    mkdir -p "$1$shared" && mount --rbind "$shared" "$1$shared"
done
root=$1 shared=$2
shift 2
exec chroot "$root" env --chdir="$shared" /opt/fogft/bin/python "$@"
"""


def python_on_arm64(shared: Path) -> Sequence[str]:
    """Return the command that starts the robot's Python, which sees one folder of this machine."""
    root = str(Path(os.environ["FOGFT_ARM64"]).resolve())
    return ("unshare", "--mount", "sh", "-ec", _ENTER, "sh", root, str(shared))


@pytest.fixture
def jetson(
    pool: Pool,
    rmw_router: Router,
    ros_domains: Callable[[], int],
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Machine]:
    """A robot that joined a pool of two replicas, without its own middleware or ROS."""
    pool.environ.update(rmw_router.environ)
    for name, value in rmw_router.environ.items():  # for the client, which is in this process
        monkeypatch.setenv(name, value)
    pool.file.write_text(
        "name: words\n"
        "resources: {any_of: [{infra: local/us-west-1}, {infra: local/us-west-2}]}\n"
        f"run: exec {sys.executable} {NODE} any 0\n"
        "fogft:\n"
        "  replicas: 2\n"
        "  rmw: zenoh\n"
        "  services: [{name: /words/echo, type: fogft_words/srv/Echo, timeout_s: 30.0}]\n"
    )
    pool.environ["PYTHONPATH"] = str(Path(__file__).parents[2])
    pool.up()
    robot = Machine(pool, "robot", "jetson", ros_domains(), python_on_arm64(pool.folder))
    robot.start()
    yield robot
    robot.kill()


def test_its_processor_is_another(tmp_path: Path) -> None:
    asked = "import platform; print(platform.machine())"
    command = [*python_on_arm64(tmp_path), "-c", asked]
    assert subprocess.check_output(command, text=True).strip() == "aarch64" != os.uname().machine


def test_its_requests_are_answered_right_while_a_replica_is_killed(
    pool: Pool, jetson: Machine
) -> None:
    """A thousand requests, a replica killed after a third of them: each gets its own answer."""
    pool.wait(lambda: links(jetson) == ["up", "up"])
    answers = asyncio.run(_ask(pool, int(jetson.environ["ROS_DOMAIN_ID"])))
    assert answers == [f"any: {number}" for number in range(REQUESTS)]
    assert jetson.process is not None
    assert jetson.process.poll() is None


def links(robot: Machine) -> list[str]:
    return [link["state"] for link in robot.report().get("links", [])]


async def _ask(pool: Pool, domain: int) -> list[str]:
    import pyzeros

    from tests.proxy.nodes.echo_over_zenoh import Echo, Text, session

    limited = asyncio.Semaphore(AT_ONCE)
    node = pyzeros.Node("robot", session=session(), domain_id=domain)
    try:
        client = node.create_client(Echo, "/words/echo")
        await asyncio.wait_for(client.wait_for_service(), 60)

        async def ask(number: int) -> str:
            async with limited:
                if number == REQUESTS // 3:
                    pool.fogft("chaos", "kill", "0")
                answer = await asyncio.wait_for(client.call_async(Text(str(number))), 60)
                return str(answer.text)

        return await asyncio.gather(*map(ask, range(REQUESTS)))
    finally:
        node.session.close()
