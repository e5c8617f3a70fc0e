"""Whatever is killed, and whenever: no orphan, no duplicate, nothing lost from the list."""

from __future__ import annotations

import contextlib
import json
import os
import random
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fogft import disk
from fogft.cloud.local import ending, processes
from fogft.cloud.local import folder as folders
from fogft.model.replica import MachinePhase, ReplicaId
from tests.fakes.waiting import wait_for

CHECKOUT = Path(__file__).parents[2]


def launcher(local, step: str, slot: int = 0, where: str = "us-west-1/a") -> subprocess.Popen:
    command = [
        *(sys.executable, "-m", "tests.cloud.launcher"),
        *(str(local.root), local.uid, str(slot), where, step),
    ]
    return subprocess.Popen(command, cwd=CHECKOUT, stderr=subprocess.PIPE, text=True)


def killed_at(local, step: str) -> ReplicaId:
    process = launcher(local, step)
    _, complaint = process.communicate(timeout=100)
    assert process.returncode == -signal.SIGKILL, complaint
    return ReplicaId(local.uid, 0, 1)


def pids(local, id: ReplicaId) -> dict[str, int]:
    return json.loads((local.folder(id) / "state.json").read_text())["pids"]


# -- the launcher


def test_a_launcher_killed_before_its_folder_is_in_place_leaves_no_machine(local):
    id = killed_at(local, "write")
    assert local.machine(id) is None
    local.running(0)
    assert os.listdir(local.root / "machines") == [str(id)], "the half-made folder is gone"


@pytest.mark.parametrize("step", ["rename", "spawn"])
def test_a_launcher_killed_before_the_process_leaves_a_machine_that_can_be_launched(local, step):
    """What was ordered is listed, though nothing runs; the same order starts it."""
    id = killed_at(local, step)
    assert local.machine(id).phase is MachinePhase.PROVISIONING
    assert processes.find(machine=str(id)) == []
    local.cloud.launch(local.order())
    assert local.wait(id, MachinePhase.RUNNING)


def test_a_machine_that_was_never_started_is_gone_after_a_while(local, monkeypatch):
    id = killed_at(local, "spawn")
    monkeypatch.setattr(folders, "START_LIMIT_S", 0.0)
    assert local.machine(id) is None
    assert not local.folder(id).exists()
    monkeypatch.undo()
    local.cloud.launch(local.order())
    assert local.wait(id, MachinePhase.RUNNING)


def test_a_process_that_is_slow_to_start_is_waited_for(local, monkeypatch):
    """An overloaded computer is no reason to end a machine before it began."""
    id = killed_at(local, "spawn")
    slow = subprocess.Popen(["sleep", "60"], env={**os.environ, processes.MACHINE: str(id)})
    try:
        wait_for(lambda: processes.find(machine=str(id)))
        monkeypatch.setattr(folders, "START_LIMIT_S", 0.0)
        assert local.machine(id).phase is MachinePhase.PROVISIONING
        monkeypatch.setattr(folders, "SLOW_START_LIMIT_S", 0.0)
        assert local.machine(id) is None
    finally:
        slow.kill()
        slow.wait()


@pytest.mark.parametrize("step", ["spawned", "done"])
def test_a_machine_outlives_its_launcher(local, step):
    id = killed_at(local, step)
    assert local.wait(id, MachinePhase.RUNNING)
    local.cloud.launch(local.order())
    wait_for(lambda: len(processes.find(machine=str(id))) == 3)  # machine, guard, server
    local.cloud.terminate(id)
    assert processes.find(pool_uid=local.uid) == []


def test_what_a_launcher_spawns_while_its_machine_is_ended_ends_as_well(local, monkeypatch):
    id, end, spawned = killed_at(local, "spawn"), processes.end_machine, []

    def spawns(machine: str) -> bool:
        ended = end(machine)
        if not spawned:
            environ = {**os.environ, processes.MACHINE: machine}
            spawned.append(subprocess.Popen(["sleep", "60"], env=environ))
            wait_for(lambda: processes.find(machine=machine))
        return ended

    monkeypatch.setattr(processes, "end_machine", spawns)
    try:
        local.cloud.terminate(id)
        assert processes.find(machine=str(id)) == []
    finally:
        spawned[0].kill()
        spawned[0].wait()


def test_a_full_disk_is_told_and_nothing_is_started(local):
    (local.root / "machines").mkdir()
    process = launcher(local, "full")
    _, complaint = process.communicate(timeout=100)
    assert process.returncode == 1
    assert complaint.startswith("CloudError: machine `0.1` cannot be created: "), complaint
    assert "File too large" in complaint
    assert os.listdir(local.root / "machines") == []
    assert processes.find(pool_uid=local.uid) == []


def test_concurrent_launches_respect_the_capacity(local):
    """Two managers cannot both have the last place."""
    running = [launcher(local, "none", slot, "us-west-2/a") for slot in range(4)]
    for process in running:
        process.wait(60)
    assert sorted(p.returncode for p in running) == [0, 0, 1, 1]
    refused = [p.communicate()[1] for p in running if p.returncode]
    assert all(text.startswith("NoCapacity: ") for text in refused), refused
    assert len(local.cloud.machines(local.uid)) == 2


# -- the machine


def test_a_second_process_for_the_same_folder_ends_and_disturbs_nothing(local):
    machine = local.running()
    second = subprocess.run(
        [sys.executable, "-m", "fogft.cloud.local.machine", str(local.folder(machine.id))],
        cwd=CHECKOUT,
        env={**os.environ, processes.MACHINE: str(machine.id)},
        capture_output=True,
        timeout=100,
        check=True,
    )
    assert second.stdout + second.stderr == b""
    assert local.machine(machine.id) == machine


def test_a_machine_that_starts_after_its_end_does_nothing(local):
    id = killed_at(local, "spawn")
    (local.folder(id) / folders.END).write_text('{"at": 0}')
    local.cloud.launch(local.order())
    wait_for(lambda: not processes.find(machine=str(id)))
    assert not (local.folder(id) / folders.STATE).exists()


@pytest.mark.parametrize("victim", ["machine", "guard"])
def test_killing_the_machine_or_its_guard_takes_all_of_it_along(local, victim, tmp_path):
    """No list and no manager is needed for that: nothing here looks until all are gone."""
    marker = tmp_path / "grandchildren"
    hidden = f"echo $$ >> {marker}; exec env -i sleep 3600"
    loud = f"echo $$ >> {marker}; exec sleep 3600"
    id = local.running(spawn=[loud, f"setsid -f bash -c {shlex.quote(loud)}", hidden]).id
    wait_for(lambda: marker.exists() and len(marker.read_text().split()) == 3)
    everyone = set(processes.find(machine=str(id)))
    assert set(map(int, marker.read_text().split())) <= everyone
    os.kill(pids(local, id)[victim], signal.SIGKILL)
    wait_for(lambda: not any(map(processes.alive, everyone)))
    assert local.folder(id).exists()
    local.wait_gone(id)


def environ(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/environ").read_bytes()
    except OSError:
        return b""


def test_terminate_ends_even_what_hides_in_a_session_with_a_clean_environment(local, tmp_path):
    marker = tmp_path / "hidden"
    id = local.running(spawn=[f"echo $$ > {marker}; exec env -i setsid sleep 3600"]).id
    pid = int(wait_for(lambda: marker.exists() and marker.read_text()))
    wait_for(lambda: environ(pid) == b"")
    local.cloud.terminate(id)
    assert not processes.alive(pid)


def test_terminate_ends_what_a_machine_starts_at_that_moment(local):
    """Each child has a clean environment, and its parent is gone at once."""
    name = f"{3600 + random.random()}"
    id = local.running(spawn=[f"while :; do (env -i setsid sleep {name} &); sleep 0.001; done"]).id

    def left() -> list[int]:
        found = []
        for path in Path("/proc").glob("[0-9]*/cmdline"):
            with contextlib.suppress(OSError):
                found += [int(path.parent.name)] if name.encode() in path.read_bytes() else []
        return found

    wait_for(lambda: len(left()) > 20)
    local.cloud.terminate(id)
    assert left() == []


def test_orphans_of_a_dead_server_end_with_the_machine(local, tmp_path):
    """What the server leaves behind becomes the machine's own, and ends with it."""
    marker = tmp_path / "left"
    spawn = [f"(echo $BASHPID > {marker}; exec env -i setsid sleep 3600) & disown; exit 0"]
    machine = local.running(spawn=spawn)
    pid = int(wait_for(lambda: marker.exists() and marker.read_text()))
    os.kill(pids(local, machine.id)["serve"], signal.SIGKILL)
    local.wait_gone(machine.id)
    wait_for(lambda: not processes.alive(pid))


def test_a_killed_machine_is_cleared_away_by_the_next_list(local):
    id = local.running().id
    processes.end(processes.find(machine=str(id)))
    wait_for(lambda: local.machine(id) is None and not local.folder(id).exists())
    assert local.cloud.log(id) is not None


def test_a_dead_machine_that_another_process_looks_at_is_left_to_it(local):
    id = killed_at(local, "spawn")
    folder = folders.MachineFolder(local.folder(id), id)
    with disk.locked(folder.path / folders.LOCK):
        assert not ending.bury(local.root, folder)
        assert folder.path.exists()
    assert ending.bury(local.root, folder)
    assert not folder.path.exists()


def test_a_signal_ends_a_machine_in_order(local):
    id = local.running().id
    os.kill(pids(local, id)["machine"], signal.SIGTERM)
    local.wait_gone(id)
    assert "signal SIGTERM" in Path(local.cloud.log(id)).read_text()


def test_a_zombie_of_ours_is_let_go(local):
    id = local.running().id
    ours = pids(local, id)["guard"]  # which is what we started
    local.cloud.terminate(id)
    local.cloud.machines(local.uid)
    assert not Path(f"/proc/{ours}").exists()


def test_nothing_of_another_pool_is_ended(local):
    """Only what carries the machine's own id is touched, however alike it is."""
    id = local.running(1).id
    alike = subprocess.Popen(
        ["sleep", "60"],
        env={**os.environ, processes.MACHINE: f"{id}1", processes.POOL: "f" * 16},
    )
    try:
        wait_for(lambda: processes.find(pool_uid="f" * 16) == [alike.pid])
        local.cloud.terminate(id)
        assert alike.poll() is None
        assert processes.find(machine=f"{id}1") == [alike.pid]
        assert processes.find(pool_uid=local.uid) == []
    finally:
        alike.kill()
        alike.wait()


def test_the_list_does_not_wait_for_a_launcher_that_hangs(local):
    """A stopped manager holds the cloud's lock; others still see what there is."""
    id = local.running().id
    holder = subprocess.Popen(
        [
            *(sys.executable, "-c"),
            "import signal, sys; from pathlib import Path; from fogft.cloud.local import ending\n"
            "with ending.cloud_lock(Path(sys.argv[1])): print('held', flush=True); signal.pause()",
            str(local.root),
        ],
        cwd=CHECKOUT,
        stdout=subprocess.PIPE,
    )
    try:
        assert holder.stdout.readline() == b"held\n"
        processes.end(processes.find(machine=str(id)))
        begin = time.monotonic()
        wait_for(lambda: local.machine(id) is None)
        assert local.folder(id).exists(), "cleared away later"
        assert time.monotonic() - begin < 30
    finally:
        holder.kill()
        holder.wait()
        holder.stdout.close()
    wait_for(lambda: local.machine(id) is None and not local.folder(id).exists())
