"""What ``fogft up`` says before, while and after it starts a pool, and what it refuses."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import chain, repeat
from pathlib import Path

import pytest

from fogft import disk
from fogft.cli import main, progress
from fogft.errors import FogftError, RosError, SpecError
from fogft.model.plain import to_plain
from fogft.model.reason import Cause, Reason
from fogft.pool.commands import init, preview, startup
from fogft.pool.commands.status import Seen, renewed
from fogft.pool.folder.store import digest
from fogft.pool.manager.status import PoolStatus, UpdateStatus
from fogft.reason_words import words
from tests.fakes.pools import REPLICA, SPEC, STATUS, lay_down

POOL = SPEC + "resources: {infra: local/us-west-2, use_spot: true}\n"
STARTING = replace(REPLICA, phase="starting", link="connecting", detail="`/plan` is not up yet")
UP = replace(STATUS, notes=(), replicas=(REPLICA,), target=1, observed_at=1e12)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A pool file for the local cloud."""
    path = tmp_path / "pool.yaml"
    path.write_text(POOL)
    return path


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch):
    """Have `up` start nothing and see one status after the other."""

    def script(*shown: object, started: bool = True) -> None:
        left = chain(shown, repeat(shown[-1] if shown else None))

        def look(*_: object) -> Seen:
            status = next(left)
            return status if isinstance(status, Seen) else Seen(status, 0.1, True)

        monkeypatch.setattr(startup, "start", lambda _: started)
        monkeypatch.setattr("fogft.pool.commands.status.read", look)
        monkeypatch.setattr(progress, "LOOK_EVERY_S", 0.0)

    return script


def test_it_says_what_it_will_do_each_change_and_how_it_ended(file, looks, capsys):
    waiting = replace(UP, ready=0, services=(replace(UP.services[0], ready_replicas=0),))
    looks(
        replace(waiting, replicas=(), services=()),
        replace(waiting, replicas=(replace(STARTING, phase="provisioning", detail=""),)),
        replace(waiting, replicas=(STARTING,)),
        replace(waiting, replicas=(STARTING,)),
        replace(UP, target=3),
    )
    assert main.run(["up", str(file)]) == 0
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.splitlines() == [
        "pool `planner`: 3 replicas on `local`",
        "  0  local/us-west-2/a  cpu4  $0.066/h",
        "  1  local/us-west-2/b  cpu4  $0.069/h",
        "  2  local/us-west-2/a  cpu4  $0.066/h",
        "  total $0.201/h",
        "0.1  provisioning at local/us-west-2/a",
        "0.1  starting",
        "0.1  `/plan` is not up yet",
        "0.1  ready",
        "done: `planner` answers, with 1 of 3 replicas ready; 2 more starting, see `fogft status`",
    ]


def test_a_clock_that_is_set_back_meanwhile_hides_no_answer(file, looks, monkeypatch):
    """What the manager saw after that has an earlier date than the file."""
    looks()
    clock, ahead_s = time.time, [3600.0]
    monkeypatch.setattr(time, "time", lambda: clock() + ahead_s[0])

    def look(*_: object) -> Seen:
        seen = Seen(replace(UP, observed_at=0.0 if ahead_s[0] else time.time()), 0.1, True)
        ahead_s[0] = 0.0
        return seen

    monkeypatch.setattr("fogft.pool.commands.status.read", look)
    assert main.run(["up", str(file), "--timeout", "2"]) == 0


def test_a_replica_that_is_lost_meanwhile_is_told(file, looks, capsys):
    other = replace(REPLICA, slot=1)
    looks(replace(UP, proxy_alive=False, notes=("no capacity",)), replace(UP, replicas=(other,)))
    assert main.run(["up", str(file)]) == 0
    lines = capsys.readouterr().err.splitlines()[5:]
    assert lines == [
        "0.1  ready at local/us-west-2/a",
        "note: no capacity",
        "1.1  ready at local/us-west-2/a",
        "0.1  gone",
        "done: `planner` answers, with 1 of 1 replicas ready",
    ]


def test_it_gives_up_with_the_reason_and_says_what_still_runs(home, file, looks, capsys):
    paths = lay_down(home, file=file)
    paths.proxy_log.write_text("first\nlast words\n")
    silent = replace(UP.services[0], ready_replicas=0)
    never = replace(
        UP, proxy_alive=False, services=(silent,), replicas=(STARTING,), notes=("no capacity",)
    )
    looks(never)
    assert main.run(["up", str(file), "--timeout", "1"]) == 1
    assert capsys.readouterr().err.endswith(
        "error: `/plan` of `planner` does not answer after 1 s\n"
        "  no capacity\n"
        "  replica 0.1: `/plan` is not up yet\n"
        "the end of the log of `proxy`:\n"
        "  first\n"
        "  last words\n"
        "\n"
        "hint: the manager keeps trying: see `fogft status` and `fogft logs`; "
        "`fogft down planner` ends it\n"
    )


def test_it_gives_up_at_once_when_run_keeps_ending(home, file, looks, capsys):
    lay_down(home, file=file)
    silent = replace(UP.services[0], ready_replicas=0)
    detail = "`run` exited with status 1: see `fogft logs 0`"
    hopeless = replace(STARTING, restarts=4, detail=detail)
    looks(updated(file, services=(silent,), replicas=(hopeless,)))
    assert main.run(["up", str(file), "--timeout", "1000"]) == 1
    said = capsys.readouterr().err
    assert "error: `/plan` of `planner` does not answer: `run` keeps exiting\n" in said
    assert f"  replica 0.1: {detail}\n" in said
    advice = "add `workdir: .` if `run` needs files from the pool file's folder"
    assert f"hint: {advice}; the manager keeps trying" in said
    file.write_text(f"{POOL}workdir: .\n")
    looks(updated(file, services=(silent,), replicas=(hopeless,)))
    assert main.run(["up", str(file), "--timeout", "1000"]) == 1
    assert advice not in capsys.readouterr().err


def test_one_replica_that_still_starts_is_worth_waiting_for(file, looks, capsys):
    silent = replace(UP.services[0], ready_replicas=0)
    hopeless = replace(STARTING, restarts=9)
    waiting = replace(STARTING, slot=1)
    looks(replace(UP, services=(silent,), replicas=(hopeless, waiting)), UP)
    assert main.run(["up", str(file)]) == 0


def test_a_manager_that_ends_meanwhile_ends_the_waiting(home, file, looks, monkeypatch, capsys):
    lay_down(home, file=file).manager_log.write_text("its last words\n")
    monkeypatch.setattr(progress, "MANAGER_GONE_S", 0.01)
    looks(Seen(STATUS, 0.1, False))
    assert main.run(["up", str(file)]) == 1
    assert (
        "error: the manager of `planner` has exited:\nits last words\n" in capsys.readouterr().err
    )
    monkeypatch.setattr(disk, "unwritable", lambda folder: "full")  # then its log may be empty
    looks(Seen(STATUS, 0.1, False))
    assert main.run(["up", str(file)]) == 1
    assert "its last words\nthe disk of `" in capsys.readouterr().err


def test_a_manager_that_another_up_replaces_is_waited_for(file, looks):
    looks(Seen(STATUS, 0.1, False), Seen(STATUS, 0.1, False), UP)
    assert main.run(["up", str(file)]) == 0


@pytest.mark.parametrize("at", ["status.read", "startup.start"])
def test_an_interrupt_says_what_goes_on(file, looks, monkeypatch, capsys, at):
    looks()

    def interrupt(*_: object) -> Seen:
        raise KeyboardInterrupt

    monkeypatch.setattr(f"fogft.pool.commands.{at}", interrupt)
    assert main.run(["up", str(file)]) == 130
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "interrupted: `planner` continues to start; `fogft down planner` shuts it down"


# --- what is refused, and changes nothing


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (POOL.replace("local/us-west-2", "local/mars"), "7: resources.infra: the local cloud has"),
        (
            POOL.replace("local/us-west-2", "azw"),
            "7: resources.infra: there is no cloud `azw`",
        ),
        (POOL.replace("GetPlan", "GetPlam"), "6: fogft.services[0].type: "),
        (POOL.replace("replicas", "replica"), "4: fogft.replica: "),
    ],
)
def test_a_mistake_is_told_with_file_line_and_key(home, file, wrong, message, capsys):
    file.write_text(wrong)
    assert main.run(["up", str(file)]) == 1
    said = capsys.readouterr()
    assert said.err.startswith(f"error: {file}:{message}"), said.err
    assert "\n\nhint: " in said.err
    assert list(home.iterdir()) == []


def test_a_file_that_is_not_there(home, capsys):
    assert main.run(["up", "no.yaml"]) == 1
    assert capsys.readouterr().err.startswith("error: no.yaml: no such file\n\nhint: ")
    assert list(home.iterdir()) == []


def test_a_file_for_another_cloud_can_be_tried_here(file, looks, capsys):
    file.write_text(POOL.replace("local/us-west-2", "aws/us-west-2"))
    looks(UP)
    assert main.run(["up", str(file), "--cloud", "local"]) == 0
    assert "  0  local/us-west-2/a" in capsys.readouterr().err
    assert main.run(["up", str(file), "--cloud", "aws"]) == 1
    assert capsys.readouterr().err == (
        "error: there is no cloud `aws`\n\n"
        "hint: clouds: `local`, `sky`; "
        "`sky` stands for the real clouds that the pool file names\n"
    )


def test_a_changed_file_is_told_in_words(home, file, looks, capsys):
    lay_down(home, file=file)
    file.write_text(POOL.replace("replicas: 3", "replicas: 2").replace("_service", "_node"))
    looks(updated(file))
    assert main.run(["up", str(file)]) == 0
    assert capsys.readouterr().err.splitlines()[:5] == [
        "pool `planner` changes:",
        "  `run`: python3 planner_service.py -> python3 planner_node.py",
        "  `resources` added",
        "  `replicas`: 3 -> 2",
        "  replicas are replaced one at a time, new before old",
    ]


def updated(file: Path, state: str = "", fault: str = "", **others: object) -> PoolStatus:
    """Return a status of a pool whose manager has seen a file, and what became of it."""
    update = UpdateStatus(state, 1, 2, fault) if state else None
    return replace(UP, applied=digest(file.read_bytes()), update=update, **others)


def test_an_update_is_waited_for(home, file, looks, capsys):
    """The pool answers all the time: that does not say that the update has come to its end."""
    lay_down(home, file=file)
    file.write_text(POOL.replace("_service", "_node"))
    looks(UP, updated(file, "in progress"), updated(file, "in progress"), updated(file))
    assert main.run(["up", str(file)]) == 0
    assert capsys.readouterr().err.endswith("with 1 of 1 replicas ready\n")


def test_an_update_that_is_rolled_back_is_an_error_with_its_reason(home, file, looks, capsys):
    lay_down(home, file=file)
    file.write_text(POOL.replace("_service", "_node"))
    fault = "replica 0.2: `run` exited 4 times"
    looks(
        updated(file, "in progress"),
        updated(file, "stopped", fault),
        updated(file, "rolled back", fault),
    )
    assert main.run(["up", str(file)]) == 1
    assert capsys.readouterr().err.endswith(
        "error: `planner` was not updated: replica 0.2: `run` exited 4 times\n\n"
        "hint: see `fogft logs`; then change this file, if only a comment, and run `fogft up`\n"
    )


def test_a_file_that_was_given_up_is_not_announced_as_a_change(home, file, looks, capsys):
    paths = lay_down(home, file=file)
    disk.write_whole(paths.good_spec, paths.spec.read_text())
    file.write_text(POOL.replace("_service", "_node"))
    disk.write_whole(paths.spec, file.read_text())
    fault = Reason(Cause.REPLICA_FAILS, replica="0.2", because=(Reason(Cause.SETUP),))
    trial = {"file": digest(file.read_bytes()), "began_at": 1.0, "fault": to_plain(fault)}
    disk.write_json(paths.trial, trial)
    looks(updated(file, "rolled back", words(fault)))
    assert main.run(["up", str(file)]) == 1
    said = capsys.readouterr().err
    assert "changes" not in said
    assert "error: `planner` was not updated: replica 0.2: setup\n" in said


def test_no_room_for_both_is_said_before(home, file, looks, capsys):
    lay_down(home, file=file)
    cap = POOL.replace("  replicas: 3", "  replicas: 3\n  max_usd_per_hour: 0.21")
    file.write_text(cap.replace("_service", "_node"))
    looks(updated(file))
    assert main.run(["up", str(file)]) == 0
    said = capsys.readouterr().err
    assert "  replicas are replaced one at a time, old before new\n" in said
    assert "  $0.21/h (`max_usd_per_hour`) leaves no room for both: one fewer replica" in said


@pytest.mark.parametrize("workdir", ["", "workdir: .\n"])
def test_the_same_file_changes_nothing(home, file, looks, capsys, workdir):
    lay_down(home, file=file).spec.write_text(SPEC + workdir)
    file.write_text(SPEC + workdir)
    looks(UP, started=False)
    assert main.run(["up", str(file)]) == 0
    first, *rest, _, last = capsys.readouterr().err.splitlines()
    assert first == "pool `planner` already matches its file"
    assert ["files in `workdir` are not compared" in line for line in rest] == [True] * bool(
        workdir
    )
    assert last == "done: `planner` answers, with 1 of 1 replicas ready"


def test_up_again_gives_a_pool_its_manager_back(home, file, looks, capsys):
    lay_down(home, file=file)
    file.write_text(SPEC)
    looks(UP)
    assert main.run(["up", str(file)]) == 0
    second = capsys.readouterr().err.splitlines()[1]
    assert second == "the pool had no manager: started a new one"


# --- init and down


def test_init_writes_an_example_and_says_how_to_go_on(tmp_path, capsys):
    into = tmp_path / "my pools"
    assert main.run(["init", "planner", "--into", str(into)]) == 0
    said = capsys.readouterr()
    files = [Path(line) for line in said.out.splitlines()]
    assert files[0] == into / "pool.yaml"
    assert all(path.is_file() for path in files)
    assert said.err == f"\nhint: look at `{files[0]}`, then run `fogft up '{files[0]}'`\n"
    assert main.run(["init", "planner", "--into", str(into)]) == 1
    assert "exist" in capsys.readouterr().err
    assert main.run(["init", "planner", "--into", str(into), "--force"]) == 0


OWN_TYPES = {
    "words": "word_interfaces",
    "detect": "detect_interfaces",
    "pick": "pick_interfaces",
    "segment": "segment_interfaces",
}


@pytest.mark.parametrize("name", [name for name in init.examples() if name not in OWN_TYPES])
def test_every_example_is_a_good_pool_file(tmp_path, name):
    files = init.copy_example(name, tmp_path / name)
    found = preview.order(files[0])
    assert len(found.launches) == found.spec.replicas
    assert found.notes == ()


@pytest.mark.parametrize(("name", "package"), OWN_TYPES.items())
def test_an_example_with_a_type_of_its_own_asks_for_its_workspace(tmp_path, name, package):
    files = init.copy_example(name, tmp_path / name)
    with pytest.raises(SpecError, match=f"no package `{package}`") as caught:
        preview.order(files[0])
    assert "source its workspace" in caught.value.hint


def test_no_machine_is_launched_for_a_robot_whose_ros_domain_is_none(tmp_path, monkeypatch):
    (file, *_) = init.copy_example("echo", tmp_path / "echo")
    for domain in ("seven", "233"):
        monkeypatch.setenv("ROS_DOMAIN_ID", domain)
        with pytest.raises(RosError, match=f"`ROS_DOMAIN_ID={domain}` is not a ROS domain"):
            preview.order(file)


def test_an_unknown_example_is_an_error(capsys):
    assert main.run(["init", "planer"]) == 1
    assert (
        capsys.readouterr().err
    ) == "error: there is no example `planer`\n\nhint: did you mean `planner`?\n"


def test_down_with_nothing_there_is_done(capsys):
    """It is safe to repeat."""
    assert main.run(["down"]) == 0
    assert capsys.readouterr().err == "no pools on this machine\n"


def test_down_ends_a_pool_whose_manager_is_dead(home, capsys):
    paths = lay_down(home, file=file)
    assert main.run(["down", "--yes"]) == 0
    assert not paths.folder.exists()
    assert capsys.readouterr().err.endswith("done: `planner` is shut down; nothing is left\n")
    assert main.run(["down"]) == 0


def test_down_of_another_name_is_a_mistake(home, capsys):
    """A misspelt name must not look like success while the real pool goes on costing money."""
    paths = lay_down(home, file=file)
    assert main.run(["down", "planer"]) == 1
    assert "error: there is no pool `planer`\n\nhint: pools: `planner`" in capsys.readouterr().err
    assert paths.identity.exists()


# --- logs


def test_logs_of_manager_and_proxy(home, capsys):
    paths = lay_down(home, file=file)
    paths.manager_log.write_text("2026-01-01T00:00:01.000 INFO manager_started\n")
    paths.proxy_log.write_text("2026-01-01T00:00:00.000 INFO proxy_started\n")
    assert main.run(["logs"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "proxy    2026-01-01T00:00:00.000 INFO proxy_started",
        "manager  2026-01-01T00:00:01.000 INFO manager_started",
    ]


def test_logs_of_a_slot_that_never_was(home, capsys):
    lay_down(home, file=file)
    assert main.run(["logs", "4"]) == 1
    assert "no log of a replica in slot 4" in capsys.readouterr().err
    for command in (["logs", "2000"], ["chaos", "kill", "2000"]):
        assert main.run(command) == 1
        assert "are started by hand: use their own machine" in capsys.readouterr().err


# --- refresh


def test_refresh_without_a_manager_shows_what_was_seen_last_and_says_so(home, capsys):
    lay_down(home, file=file)
    assert main.run(["status", "--refresh"]) == 0
    said = capsys.readouterr()
    assert said.out.startswith("planner  not answering  ? of 3 ready  $0.063/h on local  seen ")
    assert "no manager is running" in said.err


def test_refresh_fails_when_a_manager_hangs(home, monkeypatch):
    paths = lay_down(home, file=file)
    with disk.locked(paths.manager_lock):
        with pytest.raises(FogftError, match="did not refresh"):
            renewed(paths, limit_s=0.2)


@pytest.mark.parametrize(
    ("end", "status", "said"),
    [
        (None, 0, "with 1 of 1 replicas ready\n"),
        ("rolled back", 1, "error: `planner` was not updated: it crashes"),
    ],
)
def test_an_update_that_is_under_way_is_joined(home, file, looks, capsys, end, status, said):
    """The same file again: `up` waits for the update, and ends as that ends."""
    paths = lay_down(home, file=file)
    file.write_text(POOL.replace("_service", "_node"))
    disk.write_whole(paths.spec, file.read_text())
    last = updated(file, end, "it crashes") if end else updated(file)
    looks(updated(file, "in progress"), updated(file, "in progress"), last)
    assert main.run(["up", str(file)]) == status
    err = capsys.readouterr().err
    assert "is already being updated to this file: 1 of 2 replicas run it; waiting" in err
    assert said in err
