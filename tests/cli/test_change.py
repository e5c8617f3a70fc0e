"""A wish is on disk when its command returns, whether or not a manager lives."""

from __future__ import annotations

import json
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest

from fogft import disk
from fogft.cli import main, progress
from fogft.pool.commands.status import Seen
from tests.fakes.pools import FILE, REPLICA, SPEC, STATUS, alive, lay_down
from tests.fakes.threads import amid


def wish(paths):
    """Return what the manager will read."""
    return json.loads(paths.intent.read_text())


def test_scale_counts_from_what_is_wanted_now(home, capsys):
    paths = lay_down(home)
    with disk.locked(paths.manager_lock):
        assert main.run(["scale", "up", "2"]) == 0
        assert capsys.readouterr().err == "done: `planner` is scaling from 3 to 5 replicas\n"
        assert main.run(["scale", "down", "1", "--pool", "planner"]) == 0
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", "done: `planner` is scaling from 5 to 4 replicas\n")
    assert wish(paths)["target"] == 4


def test_scale_counts_from_what_an_up_meanwhile_has_asked_for(home, capsys):
    """`scale` waits while `up` writes its file."""
    paths = lay_down(home)
    with disk.locked(paths.manager_lock), ThreadPoolExecutor() as threads:
        with disk.locked(paths.intent_lock):
            scaled = amid(threads, lambda: main.run(["scale", "up", "1"]), paths.intent_lock)
            text = paths.spec.read_text()
            paths.spec.write_text(text.replace("replicas: 3", "replicas: 4"))
            assert paths.spec.read_text() != text
        assert scaled.result() == 0
    assert wish(paths)["target"] == 5
    assert "from 4 to 5 replicas" in capsys.readouterr().err


def test_the_last_replica_stays(home, capsys):
    paths = lay_down(home)
    assert main.run(["scale", "down", "3"]) == 1
    said = capsys.readouterr()
    assert said.err == (
        "error: cannot scale `planner` to 0 replicas: the minimum is 1\n\n"
        "hint: `fogft down` ends a pool\n"
    )
    assert wish(paths)["target"] is None


def test_without_a_manager_the_wish_is_kept_and_that_is_said(home, capsys):
    paths = lay_down(home)
    assert main.run(["drain", "1"]) == 0
    assert capsys.readouterr().err == (
        "done: replica `1.12` of `planner` is being replaced\n"
        "warning: `planner` has no manager: this takes effect once one is running\n\n"
        f"hint: start it with `fogft up {FILE}`\n"
    )
    assert wish(paths)["drained"] == {"1": 12}


def test_only_a_slot_with_a_replica_can_be_drained(home, capsys):
    paths = lay_down(home)
    assert main.run(["drain", "7"]) == 1
    assert capsys.readouterr().err == (
        "error: pool `planner` has no replica in slot 7\n\nhint: slots in use: 0, 1, 2\n"
    )
    assert wish(paths)["drained"] == {}


def test_exclude_and_include(home, capsys):
    paths = lay_down(home)
    with disk.locked(paths.manager_lock):
        for words in ("is now", "was already"):
            assert main.run(["exclude", "local/us-west-2/"]) == 0
            assert f"`local/us-west-2/` {words} excluded" in capsys.readouterr().err
        assert wish(paths)["excluded"] == ["local/us-west-2"]
        assert main.run(["include", "local/us-west-2"]) == 0
        assert wish(paths)["excluded"] == []
        assert main.run(["include", "local/us-west-2"]) == 1
    assert "is not excluded" in capsys.readouterr().err


def test_a_place_that_only_a_group_uses_is_excluded(home):
    paths = lay_down(home)
    groups = (
        "  groups: [{name: a, replicas: 1, resources: {infra: local/us-west-1}},"
        " {name: b, replicas: 2, resources: {infra: local/us-east-1}}]\n"
    )
    paths.spec.write_text(SPEC.replace("  replicas: 3\n", groups) + "resources: {infra: local}\n")
    assert main.run(["exclude", "local/us-east-1"]) == 0
    assert wish(paths)["excluded"] == ["local/us-east-1"]


def test_retry_is_written_down(home, capsys):
    paths = lay_down(home)
    with disk.locked(paths.manager_lock):
        assert main.run(["retry"]) == 0
    assert "`planner` will launch replicas again" in capsys.readouterr().err
    assert abs(wish(paths)["retried_at"] - time.time()) < 60


@pytest.mark.parametrize(
    ("place", "hint"),
    [("us-west-2", "`local/us-west-2`"), ("local/us-west-9", "`local/us-west-2`")],
)
def test_a_location_that_does_not_exist_is_not_excluded(home, capsys, place, hint):
    paths = lay_down(home)
    assert main.run(["exclude", place]) == 1
    said = capsys.readouterr().err
    assert f"has no location `{place}`" in said
    assert f"hint: did you mean {hint}?" in said
    assert wish(paths)["excluded"] == []


@pytest.mark.parametrize("command", [["scale", "up", "1"], ["drain", "0"], ["exclude", "local"]])
def test_a_pool_that_is_being_ended_takes_no_wishes(home, capsys, command):
    paths = lay_down(home)
    paths.intent.write_text(json.dumps({**wish(paths), "stopping": True}))
    assert main.run(command) == 1
    assert "pool `planner` is being shut down" in capsys.readouterr().err
    assert wish(paths)["target"] is None


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (["scale", "up", "1", "--wait"], "done: `planner` has 4 replicas (had 3)\n"),
        (["drain", "0", "--wait"], "done: replica `0.1` of `planner` is replaced\n"),
    ],
)
def test_what_is_waited_for_is_said_when_it_is_done(home, capsys, monkeypatch, command, said):
    """Not before the manager has seen the change, and the pool is whole again."""
    paths = lay_down(home)
    ready = [replace(REPLICA, slot=slot, generation=2) for slot in range(4)]
    whole = replace(STATUS, replicas=ready, target=4, ready=4, notes=())
    looks = iter([STATUS, whole, replace(whole, observed_at=time.time() + 60)])
    monkeypatch.setattr("fogft.pool.commands.change.read", lambda *_: Seen(STATUS, 0.1, True))
    monkeypatch.setattr("fogft.pool.commands.status.read", lambda *_: Seen(next(looks), 0.1, True))
    monkeypatch.setattr(progress, "LOOK_EVERY_S", 0.0)
    with alive(paths):
        assert main.run(command) == 0
    assert capsys.readouterr().err.endswith(said)
    assert next(looks, None) is None


def test_a_wait_without_a_manager_is_an_error(home, monkeypatch, capsys):
    lay_down(home)
    monkeypatch.setattr(progress, "MANAGER_GONE_S", 0.0)
    assert main.run(["drain", "0", "--wait"]) == 1
    assert "error: the manager of `planner` has exited" in capsys.readouterr().err
