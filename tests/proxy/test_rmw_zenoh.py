"""Robots and replicas on `rmw_zenoh`: real proxies between `pyzeros` nodes, and no ROS in them."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.needs import need
from tests.proxy.by_hand import LIMIT_S, Parts, Replica, Robot, wait_for
from tests.rmw_zenoh.rmw_router import Router

pytestmark = pytest.mark.timeout(180)
need("pyzeros")

NODE = Path(__file__).parent / "nodes" / "echo_over_zenoh.py"
SERVICES = "[{name: /words/echo, type: fogft_words/srv/Echo, timeout_s: 60.0, concurrency: 200}]"


@pytest.fixture
def parts(
    tmp_path: Path, rmw_router: Router, ros_domains: Callable[[], int],
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Parts]:  # fmt: skip
    """A pool whose every process finds the router, and no ROS: importing it fails."""
    for name in ("rclpy", "std_srvs", "fogft_words"):
        absent = f"raise ModuleNotFoundError('hidden from this test', name='{name}')\n"
        (tmp_path / "absent").mkdir(exist_ok=True)
        (tmp_path / "absent" / f"{name}.py").write_text(absent)
    root = Path(__file__).parents[2]
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path / 'absent'}:{root}")
    for name, value in rmw_router.environ.items():
        monkeypatch.setenv(name, value)
    made = Parts(tmp_path, ros_domains, services=SERVICES, node=NODE)
    yield made
    made.close()


def replica(parts: Parts, slot: int, argument: str) -> Replica:
    return Replica(parts, slot, argument, {}, extra="rmw: zenoh\n")


async def until(condition: Callable[[], Any], what: str) -> None:
    for _ in range(int(LIMIT_S / 0.05)):
        if condition():
            return
        await asyncio.sleep(0.05)
    pytest.fail(f"waited in vain: {what}")


async def within(work: Awaitable[Any]) -> Any:
    return await asyncio.wait_for(work, LIMIT_S)


def test_a_robot_of_rmw_zenoh_is_answered_by_the_first_of_its_replicas(parts: Parts) -> None:
    """A service that no package defines: found, answered a hundred times at once, kept, lost.

    One replica answers late. All of a burst are answered, each its own, by the other; when that
    one is killed the late one answers. With nobody left the service is not there any more.
    """
    late, quick = replica(parts, 0, "late 8"), replica(parts, 1, "quick 0")
    robot = Robot(parts, "arm", (late, quick), "rmw: zenoh\n")
    wait_for(lambda: robot.ready() == [0, 1], "both replicas")
    asyncio.run(_session(robot, late, quick))


async def _session(robot: Robot, late: Replica, quick: Replica) -> None:
    import pyzeros

    from tests.proxy.nodes.echo_over_zenoh import Echo, Text, session

    async def ask(text: str) -> str:
        return str((await within(client.call_async(Text(text)))).text)

    node = pyzeros.Node("robot", session=session(), domain_id=robot.domain)
    try:
        client = node.create_client(Echo, "/words/echo")
        await within(client.wait_for_service())
        first = await ask("hello")
        assert first.endswith(": hello")
        answers = await asyncio.gather(*(ask(f"{n}") for n in range(100)))
        assert [answer.split(": ")[1] for answer in answers] == [f"{n}" for n in range(100)]
        assert {answer.split(":")[0] for answer in answers} == {"quick"}
        quick.process.kill()
        assert await asyncio.gather(*(ask(f"{n}") for n in range(20))) == [
            f"late: {n}" for n in range(20)
        ]
        late.process.kill()
        querier = client.zenoh_cli
        assert querier is not None
        await until(lambda: not querier.matching_status.matching, "the service to be gone")
    finally:
        node.session.close()
