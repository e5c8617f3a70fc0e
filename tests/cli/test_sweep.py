"""``fogft sweep``: real machines of the local cloud whose managers live, died, or never were."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from fogft import disk
from fogft.cli import main
from fogft.cloud.local import processes
from fogft.cloud.sky import adapter as sky
from fogft.errors import CloudError, CloudUnreachable
from fogft.pool.commands import preview
from fogft.pool.commands.sweep import clouds_used, left_of
from fogft.pool.folder.paths import PoolPaths
from tests.cloud.conftest import Local
from tests.fakes.pools import SPEC, STATUS, lay_down
from tests.fakes.sky import replica
from tests.sky.scene import Scene


@pytest.fixture
def machines(home: Path) -> Iterator[Local]:
    """The local cloud of this state folder; all of its processes are ended at the end."""
    made = Local(home / "local")
    yield made
    processes.end(processes.find(pool_uid=made.uid))


def pool(home: Path, machines: Local, name: str = "planner") -> PoolPaths:
    """Lay a pool down that the machines belong to."""
    paths = lay_down(home, replace(STATUS, pool=name))
    identity = disk.read_json(paths.identity)
    disk.write_json(paths.identity, {**identity, "uid": machines.uid})
    return paths


@pytest.fixture(autouse=True)
def piped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have one line for each machine, as a program reads it."""
    monkeypatch.delenv("COLUMNS")


def run(capsys, *words: str, status: int = 0) -> tuple[list[str], str]:
    """Run ``fogft sweep``; return its lines on stdout, and stderr."""
    capsys.readouterr()
    assert main.run(["sweep", *words]) == status
    out, err = capsys.readouterr()
    return out.splitlines(), err


def test_what_a_living_manager_owns_is_left_alone(home, machines, capsys):
    """Even with `--end --yes`; once the manager is dead it is listed."""
    paths = pool(home, machines)
    id = machines.launch()
    lock = disk.Lock(paths.manager_lock)
    assert lock.acquire(wait=False)
    assert run(capsys, "--end", "--yes") == (
        [],
        "done: every machine belongs to a managed pool\n"
        "\nhint: no real cloud has been used from this machine; "
        "`--cloud sky` checks them anyway\n",
    )
    assert machines.machine(id)
    lock.release()
    [line], err = run(capsys)
    assert line.split()[:2] == [str(id), "local/us-west-1/a"]
    assert line.endswith("pool `planner` has no manager")
    assert "`fogft sweep --end` ends them" in err
    assert machines.machine(id), "nothing is ended unasked"


def test_a_cloud_that_could_not_be_used_is_no_cloud_that_was_used(home, monkeypatch):
    """A `plan` without SkyPilot fails, and leaves no folder for which `sweep` asks it."""
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    monkeypatch.setitem(sys.modules, "sky", None)
    with pytest.raises(CloudError, match="SkyPilot cannot be used here"):
        sky.make(home / "sky")
    assert clouds_used() == ["local"]


def test_the_machines_of_a_pool_that_was_exported_are_left_to_who_manages_it_now(
    home, machines, capsys
):
    paths = pool(home, machines)
    id = machines.launch()
    os.replace(paths.identity, paths.exported)
    damaged = PoolPaths.of("planned", home).exported
    damaged.parent.mkdir()
    damaged.write_text("{")
    assert run(capsys, "--end", "--yes")[0] == []
    assert machines.machine(id)


def test_a_machine_whose_pool_was_lost_is_found_and_ended(home, machines, capsys, tmp_path):
    """All of its processes go, and nothing of another pool's. An `up` of its name tells of it."""
    id = machines.running(task={"run": "x"}).id
    file = tmp_path / "pool.yaml"
    file.write_text(SPEC.replace("planner\n", "test\n", 1) + "resources: {infra: local}\n")
    (note,) = [one for one in preview.order(file).notes if "earlier pool" in one]
    assert f"at $0.070/h in total: `{id}`." in note
    assert "`fogft sweep --end` ends them" in note
    file.write_text(SPEC + "resources: {infra: local}\n")
    assert "earlier pool" not in str(preview.order(file).notes), "another name"
    [line], _ = run(capsys)
    assert line.endswith(f"no pool of this uid (`test`) in `{home}`")
    _, err = run(capsys, "--end", "--yes")
    assert f"ended `{id}` (local/us-west-1/a)\ndone: ended all of them\n" in err
    assert processes.find(machine=str(id)) == []
    assert run(capsys)[0] == []


@pytest.mark.parametrize(("answer", "goes"), [("y\n", True), ("n\n", False), ("", False)])
def test_a_person_is_asked_first(machines, capsys, monkeypatch, answer, goes):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    id = machines.launch()
    monkeypatch.setattr("sys.stdin", Terminal(answer))
    _, err = run(capsys, "--end", status=0 if goes else 1)
    assert "end 1? [y/N]" in err
    assert (machines.machine(id) is None) is goes


def test_nobody_to_ask_is_a_no(machines, capsys, monkeypatch):
    id = machines.launch()
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    _, err = run(capsys, "--end", status=1)
    assert "add `--yes`" in err
    assert machines.machine(id)


def test_a_pool_that_cannot_be_read_ends_nothing(home, machines, capsys):
    """Its machines would look like nobody's."""
    pool(home, machines).identity.write_text("{torn")
    id = machines.launch()
    _, err = run(capsys, "--end", "--yes", status=1)
    assert err.startswith("error: ")
    assert machines.machine(id)


def test_a_manager_that_comes_back_meanwhile_keeps_its_machines(
    home, machines, capsys, monkeypatch
):
    """Between the list and the end somebody ran `fogft up`."""
    paths = pool(home, machines)
    id = machines.launch()
    lock = disk.Lock(paths.manager_lock)

    def yes(question: str) -> bool:
        return lock.acquire(wait=False)

    monkeypatch.setattr("fogft.cli.output.confirm", yes)
    _, err = run(capsys, "--end")
    assert f"`{id}` was left alone: its pool has a manager again" in err
    assert machines.machine(id)
    lock.release()


# -- real clouds, on the scripted SkyPilot ----------------------------------------------------


@pytest.fixture
def scene(home: Path, monkeypatch: pytest.MonkeyPatch) -> Scene:
    """Real clouds were used from here."""
    (home / "sky").mkdir()
    scene = Scene(home / "sky")
    monkeypatch.setattr(sky, "make", lambda folder: scene.cloud)
    return scene


def test_a_vm_that_only_its_cloud_still_knows_is_found_and_ended(scene, capsys):
    """The pool's folder, our notes and SkyPilot's database are gone; the label is left."""
    scene.launched()
    scene.sky.forget_everything()
    scene.cloud.journal.close(replica())
    told = left_of("perception", "sky", scene.cloud)
    assert "at $0.021/h in total" in told[0]
    assert str(replica()) in told[0]
    assert left_of("planner", "sky", scene.cloud) == []
    [line], err = run(capsys)
    assert line.split()[:3] == [str(replica()), "aws/us-east-1/us-east-1a", "$0.021/h"]
    assert "checked all of SkyPilot's clouds, and `aws` directly" in err
    run(capsys, "--end", "--yes")
    assert scene.provider.found == {}


def test_a_cloud_that_does_not_answer_is_no_empty_list(scene, capsys):
    scene.launched()
    scene.sky.unreachable = True
    out, err = run(capsys, status=1)
    assert out == []
    assert err.startswith("error: SkyPilot did not answer")


def test_what_does_not_end_is_an_error_with_what_to_do(scene, capsys):
    name = scene.launched()
    scene.sky.fail_next("down", CloudUnreachable("no answer"), times=20)
    _, err = run(capsys, "--end", "--yes", status=1)
    assert f"error: `{name}` may still be running: no answer" in err
    assert f"end it with `sky down {name}`" in err
