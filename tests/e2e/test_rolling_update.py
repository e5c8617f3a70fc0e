"""A changed file under load: it takes over, or the good one comes back. No request is lost."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from typing import Any

import pytest

import fogft
from tests.e2e.pool import NODES
from tests.needs import needs
from tests.proxy.by_hand import ROOT

pytestmark = [pytest.mark.e2e, pytest.mark.ros, pytest.mark.timeout(400)]


def flawless(result: dict[str, Any]) -> bool:
    return result["failed"] == result["wrong"] == result["twice"] == 0


def replicas(pool) -> set[tuple[int, int]]:
    return {(r["slot"], r["generation"]) for r in pool.status()["replicas"]}


def test_a_version_that_crashes_is_rolled_back_and_the_next_one_taken_with_an_upgrade(pool):
    """Under load: a bad file is given up, the good version serves on, a mended file is taken.

    All that runs was started by another version of fogft: `status` says so, and the `up` that
    takes the mended file replaces it all. Versions of the stateful service never mix: the new one
    adds ten where the old one adds one, so that each answer shows who computed it.
    """
    before = pool.folder / "before"
    for name in ("fogft", "templates"):
        shutil.copytree(ROOT / name, before / name)  # as compiled: it is the same code
    init = before / "fogft" / "__init__.py"
    init.write_text(init.read_text().replace(fogft.__version__, "0.0.9"))
    write(pool, "old 1")
    ours = pool.environ.get("PYTHONPATH", "")
    pool.environ["PYTHONPATH"] = f"{before}{os.pathsep}{ours}"
    pool.up()
    pool.wait(lambda: (pool.folder / "home" / "pools" / "e2e" / "good.yaml").exists())
    old = replicas(pool)
    client, counting = pool.client(300, 5), Counting(pool)

    write(pool, "bad 100", plan="no_such_service.py")
    said = pool.fogft("up", str(pool.file), "--yes", ok=False)
    assert "new before old" in said
    assert "error: `e2e` was not updated: replica " in said
    assert "can't open file" in said, "the end of that replica's log"
    assert "update stopped" in pool.fogft("events")
    assert "`run` exited " in said
    status = pool.wait(lambda: rolled_back(pool))
    assert "`run` exited " in status["update"]["fault"]
    pool.wait(lambda: pool.ready() == 2)
    assert replicas(pool) == old, "the good ones were never touched"
    log = (pool.folder / "home" / "pools" / "e2e" / "manager.log").read_text()
    assert "update_stopped" in log
    assert "was not updated" in pool.fogft("up", str(pool.file), "--yes", ok=False)
    assert replicas(pool) == old

    status = pool.status()
    assert versions(status) == {"0.0.9"}
    pool.environ["PYTHONPATH"] = ours
    assert "runs fogft 0.0.9" in pool.fogft("status", ok=False)
    write(pool, "new 10")
    first = subprocess.Popen(
        [sys.executable, "-m", "fogft", "up", str(pool.file), "--yes"],
        env=pool.environ, cwd=pool.folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True,
    )  # fmt: skip
    pool.wait(lambda: (pool.status()["update"] or {}).get("state") == "in progress")
    pool.fogft("up", str(pool.file), "--yes", limit_s=200)  # joins what is under way
    assert not old & replicas(pool), "`up` returns once the update is done"
    assert pool.status()["update"] is None
    said = first.communicate(timeout=100)[0]
    assert first.returncode == 0, said
    assert "0.0.9" in said
    pool.wait(lambda: versions(pool.status()) == {fogft.__version__})
    assert pool.status()["manager_pid"] != status["manager_pid"]
    result = client.finish()
    assert result["requests"] > 100
    assert flawless(result), result
    never_mixed(counting.finish())


def versions(status: dict[str, Any]) -> set[str]:
    """Return by which versions of fogft a pool's processes run."""
    replicas = {one["version"] for one in status["replicas"]}
    return {status["manager_version"], status["proxy_version"], *replicas}


def rolled_back(pool) -> dict[str, Any] | None:
    status = pool.status()
    update = status["update"]
    return status if update and update["state"] == "rolled back" else None


@needs("night")  # by day in simulated time: tests/simulation/test_rolling_updates.py
def test_old_goes_before_new_where_the_budget_has_no_room_for_both(pool):
    """The cap has room for two and no third: one always answers, and none is lost."""
    pool.write(replicas=2)
    pool.up()
    paid = pool.status()["usd_per_hour"]
    more = f"  max_usd_per_hour: {paid * 1.25:.4f}\n"
    pool.write(replicas=2, more=more)
    pool.up()
    before = replicas(pool)
    client = pool.client(300, 10)
    pool.write(replicas=2, work_s=0.006, more=more)
    said = pool.fogft("up", str(pool.file), "--yes", ok=False, limit_s=200)
    assert "old before new" in said
    assert not before & replicas(pool), said
    assert pool.status()["usd_per_hour"] <= paid * 1.25
    result = client.finish()
    assert flawless(result), result


class Counting:
    """A running count_client.py."""

    def __init__(self, pool) -> None:
        self._process = subprocess.Popen(
            [sys.executable, f"{NODES}/count_client.py"],
            env=pool.environ, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self._process.stderr is not None
        assert any(line.startswith("asking") for line in self._process.stderr)

    def finish(self) -> list[str | None]:
        self._process.send_signal(signal.SIGINT)
        out, err = self._process.communicate(timeout=100)
        assert self._process.returncode == 0, err
        return json.loads(out)


def never_mixed(answers: list[str | None]) -> None:
    """Check that no answer is missing, and that one version computed after the other."""
    assert None not in answers, "a request was lost"
    said = [(word, int(total)) for word, total in map(str.split, answers)]
    versions = [version for version, _ in said]
    assert versions == sorted(versions, reverse=True), "old and new took turns"
    assert {"old", "new"} == set(versions)
    before = 0
    for version, total in said:
        before += 1 if version == "old" else 10
        assert total == before, (version, total)


def write(pool, count: str, plan: str = "plan_service.py") -> None:
    """Write a pool file with two services, one of which has state; `count` is its arguments."""
    python = f"{sys.executable} {NODES}"
    pool.file.write_text(
        "name: e2e\n"
        "resources: {any_of: [{infra: local/us-west-1}, {infra: local/us-west-2}]}\n"
        f"run: {python}/count_service.py {count} & exec {python}/{plan} 0.005\n"
        "fogft:\n"
        "  replicas: 2\n"
        "  services:\n"
        "    - {name: /plan, type: nav_msgs/srv/GetPlan, timeout_s: 10.0}\n"
        "    - name: /count\n"
        "      type: std_srvs/srv/SetBool\n"
        "      timeout_s: 10.0\n"
        "      state: {snapshot: /count/get_state, restore: /count/set_state}\n"
    )
