"""A whole pool with one replica in wrong hands: it goes, and nothing else changes.

The pool's file lists no services: what replicas say decides what the robot is offered.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import pytest

from fogft.model.reason import Cause
from tests.e2e.conftest import pool
from tests.e2e.pool import NODES, Pool
from tests.hostile.orders import CLAIMED, ESCAPES, HOSTILE

__all__ = ["pool"]
pytestmark = [pytest.mark.e2e, pytest.mark.ros, pytest.mark.timeout(240)]

ROOT, SITE = Path(__file__).parents[2], Path(__file__).parent / "site"
LIES_FOR_S = 3.0


def test_a_hostile_replica_is_replaced_and_costs_nothing_else(pool: Pool, tmp_path: Path) -> None:
    """It claims services, writes to the terminal, and answers junk first, under load."""
    orders = tmp_path / "orders"
    path = os.pathsep.join([str(SITE), str(ROOT), os.environ.get("PYTHONPATH", "")])
    pool.environ.update({HOSTILE: str(orders), "FOGFT_HOSTILE_MACHINE": "0.1", "PYTHONPATH": path})
    pool.file.write_text(
        "name: e2e\n"
        "resources: {any_of: [{infra: local/us-west-1}, {infra: local/us-west-2}]}\n"
        f"run: exec {sys.executable} {NODES}/plan_service.py 0.005\n"
        "fogft: {replicas: 3}\n"
    )
    pool.up()
    client = pool.client(60.0, 20.0)
    for lie in ("claims", "escapes"):
        orders.write_text(lie)
        if lie == "claims":
            pool.wait(lambda: Cause.OUTVOTED.value in str(pool.status()["reasons"]))
        time.sleep(LIES_FOR_S)
        status = pool.status()
        shown = pool.fogft("status")
        assert ESCAPES not in shown
        assert "\x1b" not in shown
        assert [one["name"] for one in status["services"]] == ["/plan"]
        honest = [one for one in status["replicas"] if one["slot"] != 0]
        assert [(one["generation"], one["phase"]) for one in honest] == [(1, "ready")] * 2
    orders.write_text("junk 11")
    pool.wait(lambda: _generations(pool) == {0: 2, 1: 1, 2: 1} and pool.ready() == 3)
    result = client.finish()
    status = pool.status()
    print(result)
    assert (result["failed"], result["wrong"], result["twice"]) == (0, 0, 0)
    assert Cause.MISREAD.value in str(status["events"])
    launched = [one for one in status["events"] if one["event"] == "launched"]
    assert len(launched) == 4
    assert CLAIMED not in str(status["services"])
    assert _generations(pool) == {0: 2, 1: 1, 2: 1}


def _generations(pool: Pool) -> dict[int, int]:
    return {one["slot"]: one["generation"] for one in pool.status()["replicas"]}
