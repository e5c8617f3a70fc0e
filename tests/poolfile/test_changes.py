"""A changed pool file is told in words before it is applied."""

from __future__ import annotations

from dataclasses import replace

from fogft.model.spec import HealthSpec, OnTimeout, PoolSpec, ServiceSpec
from fogft.poolfile.changes import changes, replaces_replicas

PLAN = ServiceSpec("/plan", "nav_msgs/srv/GetPlan")
POOL = PoolSpec("planner", (PLAN,), task={"run": "python plan.py", "resources": {"cpus": 2}})


def test_the_same_file_changes_nothing():
    assert changes(POOL, POOL) == []
    assert not replaces_replicas(POOL, POOL)


def test_numbers_are_told_with_old_and_new():
    after = replace(POOL, replicas=3, max_usd_per_hour=1.0, health=HealthSpec(suspect_after_s=0.5))
    assert changes(POOL, after) == [
        "`replicas`: 2 -> 3",
        "`max_usd_per_hour`: none -> 1",
        "`health`: `suspect_after_s`: 2 -> 0.5",
    ]
    assert not replaces_replicas(POOL, after)


def test_services_are_told_by_name():
    slower = replace(PLAN, timeout_s=30.0, on_timeout=OnTimeout.EMPTY)
    after = replace(POOL, services=(slower, ServiceSpec("/scan", "std_srvs/srv/Trigger")))
    assert changes(POOL, after) == [
        "service `/plan`: `timeout_s`: 10 -> 30",
        "service `/plan`: `on_timeout`: silent -> empty",
        "service `/scan` added",
    ]
    assert changes(after, POOL)[-1] == "service `/scan` removed"
    assert replaces_replicas(POOL, after)


def test_the_rest_of_the_task_is_told_by_key():
    after = replace(
        POOL, task={"run": "python other.py", "resources": {"cpus": 4}, "setup": "make\nmake all"}
    )
    assert changes(POOL, after) == [
        "`run`: python plan.py -> python other.py",
        "`resources` changed",
        "`setup` added",
    ]
    assert replaces_replicas(POOL, after)


def test_a_longer_command_is_not_quoted():
    after = replace(POOL, task={**POOL.task, "run": "x" * 41})
    assert changes(POOL, after) == ["`run` changed"]
