"""A whole pool under load with hostile parties: they go, or stay outside, and nothing else changes.

The pool's file lists no services: what replicas say decides what the robot is offered.
"""

from __future__ import annotations

import os
import random
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from fogft.link.port import Peer
from fogft.link.zenoh.replica.door import HOST_LIMIT
from fogft.model import names
from fogft.model.reason import Cause
from fogft.model.replica import ReplicaId
from fogft.proxy.config import read_client
from tests.e2e.conftest import pool
from tests.e2e.pool import NODES, Machine, Pool
from tests.hostile.orders import CLAIMED, ESCAPES, HOSTILE
from tests.hostile.robot import Target, greets, sends, session_at
from tests.hostile.test_flood import stranger

__all__ = ["pool"]
pytestmark = [pytest.mark.e2e, pytest.mark.ros, pytest.mark.timeout(400)]

ROOT, SITE = Path(__file__).parents[2], Path(__file__).parent / "site"
FRAMES = 200  # of the hostile robot, at each replica, while another lies
DEADLINE_S = 10.0  # of a request, where the pool's file names none


def test_hostile_parties_cost_a_pool_nothing_but_their_own_machine(
    pool: Pool, tmp_path: Path
) -> None:
    """A replica claims services and writes to the terminal, while a robot and a stranger attack.

    Then it takes requests and answers none. It is replaced, by one that answers junk: so is that.
    Nothing is lost, wrong, answered twice or too late, and only these two machines are launched.
    """
    orders = tmp_path / "orders"
    path = os.pathsep.join([str(SITE), str(ROOT), os.environ.get("PYTHONPATH", "")])
    lying = {HOSTILE: str(orders), "FOGFT_HOSTILE_MACHINES": "0.1 0.2", "PYTHONPATH": path}
    pool.environ.update(lying)
    pool.file.write_text(
        "name: e2e\n"
        "resources: {any_of: [{infra: local/us-west-1}, {infra: local/us-west-2}]}\n"
        f"run: exec {sys.executable} {NODES}/plan_service.py 0.005\n"
        "fogft: {replicas: 3}\n"
    )
    pool.up()
    eve = Machine(pool, "robot", "eve")
    whole, usd_per_hour = _generations(pool), _usd_per_hour(pool)
    client = pool.client(200.0, 5.0, 20.0)
    with ExitStack() as attacked:
        attacks = [
            attacked.enter_context(_attacked(pool, eve, one)) for one in pool.status()["replicas"]
        ]
        endpoint = next(one["endpoint"] for one in pool.status()["replicas"] if one["slot"] == 1)
        attacked.enter_context(stranger(endpoint, "hello"))
        for number, lie in enumerate(("claims", "escapes"), 1):
            orders.write_text(lie)
            if lie == "claims":
                pool.wait(lambda: Cause.OUTVOTED.value in str(pool.status()["reasons"]))
            enough = number * FRAMES // 2
            pool.wait(lambda enough=enough: all(sent() >= enough for sent in attacks))
            status = pool.status()
            shown = pool.fogft("status")
            assert ESCAPES not in shown
            assert "\x1b" not in shown
            assert [one["name"] for one in status["services"]] == ["/plan"]
            pool.wait(lambda: [one["phase"] for one in _replicas(pool)[1:]] == ["ready"] * 2)
            assert _generations(pool) == whole
        pool.wait(lambda: _replicas(pool)[1]["strangers"] >= HOST_LIMIT)
    assert (_generations(pool), _usd_per_hour(pool)) == (whole, usd_per_hour)
    for generation, lie in enumerate(("swallowed", "junk 11"), 2):
        orders.write_text(lie)
        pool.wait(lambda now=generation: _generations(pool) == whole | {0: now})
        orders.write_text("honest")
        pool.wait(lambda: [one["phase"] for one in _replicas(pool)] == ["ready"] * 3)
    result = client.finish()
    status = pool.status()
    print(result)
    assert (result["failed"], result["wrong"], result["twice"]) == (0, 0, 0)
    assert result["max_s"] < DEADLINE_S
    assert Cause.IGNORES.value in str(status["events"])
    assert Cause.MISREAD.value in str(status["events"])
    launched = [one for one in status["events"] if one["event"] == "launched"]
    assert len(launched) == 3 + 2
    assert CLAIMED not in str(status["services"])
    assert _generations(pool) == {0: 3, 1: 1, 2: 1}
    assert _usd_per_hour(pool) == usd_per_hour


@contextmanager
def _attacked(pool: Pool, eve: Machine, replica: dict[str, Any]) -> Iterator[Callable[[], int]]:
    """A robot of the pool's own sends a replica damaged frames; yield how many it has sent."""
    config = read_client(eve.config)
    id = ReplicaId(config.pool_uid, replica["slot"], replica["generation"])
    key = names.service_key(config.pool_uid, id.slot, "/plan", "nav_msgs/srv/GetPlan")
    at = Target(Peer(id, replica["endpoint"], id.certificate_name), key)
    enough, sent = threading.Event(), 0
    with session_at(at, config.credentials) as session:
        send = sends(session, greets(session, config.credentials, at), random.Random(id.slot), at)

        def throw() -> None:
            nonlocal sent
            while not enough.wait(0.01):
                send()
                sent += 1

        thread = threading.Thread(target=throw, daemon=True)
        thread.start()
        try:
            yield lambda: sent
        finally:
            enough.set()
            thread.join()


def _replicas(pool: Pool) -> list[dict[str, Any]]:
    return sorted(pool.status()["replicas"], key=lambda one: int(one["slot"]))


def _generations(pool: Pool) -> dict[int, int]:
    return {one["slot"]: one["generation"] for one in _replicas(pool)}


def _usd_per_hour(pool: Pool) -> float:
    return sum(float(one["usd_per_hour"]) for one in _replicas(pool))
