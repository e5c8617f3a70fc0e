"""The example `inspection`: its replicas keep their state in a real etcd, for two robots."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fogft.pool.commands import init
from tests.e2e.pool import NODES, Machine, Pool
from tests.examples.loading import modules
from tests.needs import need
from tests.ports import free_port

need("etcd")
pytestmark = pytest.mark.timeout(240)
with modules("inspection", "places") as found:
    (places,) = found

COUNT = 10


@pytest.fixture
def etcd(tmp_path: Path) -> Iterator[str]:
    """Start a real etcd of one member on loopback; yield its URL."""
    client, peer = (f"http://127.0.0.1:{free_port()}" for _ in range(2))
    with (tmp_path / "etcd.log").open("wb") as log:
        process = subprocess.Popen(
            ["etcd", "--name", "one", "--data-dir", str(tmp_path / "etcd"),
             "--listen-client-urls", client, "--advertise-client-urls", client,
             "--listen-peer-urls", peer, "--initial-advertise-peer-urls", peer,
             "--initial-cluster", f"one={peer}"],
            stdout=log, stderr=log,
        )  # fmt: skip
    try:
        places.Places([client]).given_out()  # waits until it answers
        yield client
    finally:
        process.kill()
        process.wait()


def test_copies_of_a_request_count_once_and_requests_never_share_a_place(etcd):
    """Many replicas at once, each given every request, some in another order."""
    ids = [str(number) for number in range(20)]
    orders = [ids, ids[::-1], ids[10:] + ids[:10]]
    store = places.Places(["http://127.0.0.1:9", etcd])  # one of its members is away

    def work(order: list[str]) -> dict[str, int]:
        replica = places.Places([etcd])
        return {id: replica.take(id) for id in order}

    with ThreadPoolExecutor(len(orders)) as pool:
        answers = list(pool.map(work, orders))
    assert answers[0] == answers[1] == answers[2]
    assert sorted(answers[0].values()) == list(range(len(ids)))
    assert store.given_out() == len(ids)


@pytest.fixture
def ada(pool: Pool, etcd: str, ros_domains: Callable[[], int]) -> Iterator[Machine]:
    """A second robot of the example's pool, which is up and has a rendezvous."""
    meeting = f"127.0.0.1:{free_port()}"
    folder = pool.folder / "inspection"
    init.copy_example("inspection", folder)
    pool.file = folder / "pool.yaml"
    text = pool.file.read_text().replace("http://127.0.0.1:2379", etcd)
    pool.file.write_text(f"{text}  rendezvous: ['{meeting}']\n")
    pool.up()
    meet = Machine(pool, "rendezvous", "meet")
    meet.configure(listen=meeting)
    meet.start()
    pool.wait((meet.config.parent / "status.json").exists)  # who joins asks it
    robot = Machine(pool, "robot", "ada", ros_domains())
    robot.start()
    yield robot
    robot.kill()
    meet.kill()


@pytest.mark.e2e
@pytest.mark.ros
def test_two_robots_get_every_place_once_though_replicas_are_killed(pool, etcd, ada):
    """Each request goes to both replicas: none is applied twice, and none is lost."""
    store = places.Places([etcd])
    program = pool.file.parent / "inspection_client.py"
    client = [sys.executable, str(program), "--count", str(COUNT)]
    said = subprocess.run(client, env=pool.environ, stdout=subprocess.PIPE, check=True).stdout
    first = [tuple(json.loads(line)) for line in said.splitlines()]
    assert len(first) == COUNT
    robots = [Asking(program.parent, environ) for environ in (pool.environ, ada.environ)]
    try:
        for slot in ("0", "1"):
            before = store.given_out()
            pool.wait(lambda before=before: store.given_out() > before + COUNT)
            pool.fogft("chaos", "kill", slot)
            pool.wait(lambda slot=slot: slot in replaced(pool) and reaches_both(ada))
        one, two = (robot.finish() for robot in robots)
    finally:
        for robot in robots:
            robot.process.kill()
    assert min(len(one), len(two)) >= COUNT
    told = first + one + two
    assert sorted(told) == sorted((float(n % 10), float(n // 10)) for n in range(len(told)))
    assert store.given_out() == len(told)


class Asking:
    """A robot that asks for one place after the other; see `inspecting_robot.py`."""

    def __init__(self, folder: Path, environ: dict[str, str]) -> None:
        words = [sys.executable, str(NODES / "inspecting_robot.py"), str(folder)]
        self.process = subprocess.Popen(words, env=environ, stdout=subprocess.PIPE, text=True)

    def finish(self) -> list[tuple[float, float]]:
        """Have it end with what it asks now; return all places that it was told."""
        self.process.send_signal(signal.SIGINT)
        said = self.process.communicate(timeout=100)[0]
        assert self.process.returncode == 0
        return [tuple(json.loads(line)) for line in said.splitlines()]


def replaced(pool: Pool) -> set[str]:
    """Return the slots of replicas that are ready in a later generation than the first."""
    ready = [r for r in pool.status()["replicas"] if r["phase"] == "ready"]
    return {str(r["slot"]) for r in ready if r["generation"] > 1}


def reaches_both(robot: Machine) -> bool:
    """Whether a robot's links to two replicas are up."""
    return [link["state"] for link in robot.report().get("links", [])] == ["up", "up"]
