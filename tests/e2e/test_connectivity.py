"""A whole pool of several machines: a rendezvous, two gateways, replicas that nobody can reach."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest

from tests.e2e.pool import Machine, Pool
from tests.ports import free_port

pytestmark = [pytest.mark.e2e, pytest.mark.ros, pytest.mark.timeout(600)]

GATEWAYS = ("east", "west")


@pytest.fixture
def machines() -> Iterator[dict[str, Machine]]:
    """Other machines of the pool, by name; ended with the test."""
    made: dict[str, Machine] = {}
    yield made
    for machine in made.values():
        machine.kill()


def local() -> str:
    return f"127.0.0.1:{free_port()}"


def passed(machine: Machine) -> int:
    """Return how many requests a gateway has passed on."""
    return int(machine.report().get("forwarded", {}).get("passed", 0))


def report(pool: Pool) -> dict[str, Any]:
    """Return what the robot's client proxy reports; nothing before it does."""
    try:
        path = pool.folder / "home" / "pools" / "e2e" / "proxy-status.json"
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError):
        return {}


def up_of(seen: dict[str, Any], what: str) -> list[dict[str, Any]]:
    return [one for one in seen.get(what, []) if one["state"] == "up" and one["ready"]]


def ready(seen: dict[str, Any]) -> set[int]:
    """Return the slots that a robot or a gateway could ask."""
    return {link["slot"] for link in up_of(seen, "links")}


def phases(status: dict[str, Any]) -> dict[int, str]:
    """Return the phase of each slot's replica, those that were started by hand included."""
    return {one["slot"]: one["phase"] for one in [*status["replicas"], *status["by_hand"]]}


def drawn(pool: Pool) -> str:
    """Return the tree that `fogft status` draws."""
    return pool.fogft("status").partition("TOPOLOGY\n")[2]


def test_a_pool_behind_gateways_whose_replicas_dial_out(pool, machines, ros_domains):
    """Robot to one of two gateways, which the replicas dial; the one in use dies under load.

    Who is where is learned from the rendezvous alone: the pool file names no replica's address,
    and no replica has one. One more replica joins by hand, on a machine of its own.
    """
    wait = partial(pool.wait, limit_s=180)
    meeting, at = local(), {name: local() for name in GATEWAYS}
    listed = ", ".join(f"{{name: {name}, endpoint: '{at[name]}'}}" for name in GATEWAYS)
    pool.write(
        replicas=2,
        more=f"  rendezvous: ['{meeting}']\n  dial_in: {local()}\n"
        f"  topology: {{gateways: [{listed}], default_gateways: [{', '.join(GATEWAYS)}]}}\n",
    )
    up = subprocess.Popen(
        [sys.executable, "-m", "fogft", "up", str(pool.file), "--yes"],
        env=pool.environ, cwd=pool.folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True,
    )  # fmt: skip
    wait((pool.folder / "home" / "pools" / "e2e" / "status.json").exists)
    machines["meet"] = Machine(pool, "rendezvous", "meet")
    machines["meet"].configure(listen=meeting)
    machines["meet"].start()
    wait((machines["meet"].config.parent / "status.json").exists)  # who joins asks it
    for name in GATEWAYS:
        door = local()
        machines[name] = Machine(pool, "gateway", name)
        machines[name].configure(listen=at[name], dial_in=door, dial_in_listen=door)
        machines[name].start()
    machines["lab"] = Machine(pool, "replica", "2000", ros_domains())
    machines["lab"].configure(listen=local())
    machines["lab"].start()
    said = up.communicate(timeout=300)[0]
    assert up.returncode == 0, said
    wait(lambda: len(up_of(report(pool), "gateways")) == len(GATEWAYS))
    wait(lambda: all(ready(machines[name].report()) == {0, 1, 2000} for name in GATEWAYS))
    wait(lambda: ready(report(pool)) == {0, 1, 2000})
    client = pool.client(120, 10)
    wait(lambda: sum(passed(machines[name]) for name in GATEWAYS) > 10)
    used = max(GATEWAYS, key=lambda name: passed(machines[name]))
    (other,) = set(GATEWAYS) - {used}
    before = passed(machines[other])
    machines[used].kill()
    wait(lambda: passed(machines[other]) > before + 10)
    wait(lambda: {link["through"] for link in up_of(report(pool), "links")} == {other})
    wait(lambda: len(up_of(report(pool), "gateways")) == 1)
    tree = wait(lambda: (tree := drawn(pool)).count(" up ") == 1 and tree).splitlines()
    wait(lambda: phases(pool.status()) == {0: "ready", 1: "ready", 2000: "ready"})
    result = client.finish()
    assert result["requests"] > 20
    assert result["failed"] == result["wrong"] == result["twice"] == 0, result
    assert tree[0].startswith("robot ")
    doors = [line for line in tree if "── gateway " in line]  # long lines are folded
    for line, mark, name in zip(doors, "├└", GATEWAYS, strict=True):
        assert line.startswith(f"{mark}── gateway {name}  {at[name]}  "), line
        assert (" up" in line) == (name == other)
    assert machines[other].report()["door"]["tunnels"] >= 3
    pool.fogft("down")
    assert pool.left() == {}


def test_a_pool_launches_its_own_gateway_and_another_when_that_is_lost(pool):
    """`up` needs no more than `gateway: {launch: true}`; its machine is the pool's, and ends."""
    port = free_port()  # the next two are taken, too
    pool.write(replicas=1, more=f"  gateway: {{launch: true, port: {port}}}\n")
    pool.up()
    client = pool.client(3, 25)
    assert f"── gateway gateway  127.0.0.1:{port}  up" in drawn(pool)
    (machine,) = (pool.folder / "home/local/machines").glob("*-1999.1")
    assert client.result()["failed"] == 0
    os.kill(json.loads((machine / "state.json").read_text())["pids"]["machine"], signal.SIGKILL)
    pool.wait(lambda: not up_of(report(pool), "gateways"))
    pool.wait(lambda: up_of(report(pool), "gateways") and ready(report(pool)) == {0})
    result = pool.client(3, 25).result()
    assert result["answered"] == result["requests"] > 50
    assert "replica 1999.2" in pool.fogft("down", ok=False)
    assert pool.left() == {}
