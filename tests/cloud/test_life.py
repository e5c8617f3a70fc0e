"""A machine of the local cloud from its order to its end."""

from __future__ import annotations

import json
import os
import shutil
import socket
import stat
import threading
from pathlib import Path

import pytest

from fogft.cloud.local import ending, processes
from fogft.cloud.local import folder as folders
from fogft.errors import CloudError, NoCapacity
from fogft.model.reason import Cause, Reason
from fogft.model.replica import MachinePhase, ReplicaId
from tests.fakes.waiting import wait_for

HELLO = b"\x16\x03hello"  # as TLS begins, or it is not passed on


def echo(endpoint: str, data: bytes = HELLO) -> bytes:
    host, port = endpoint.split(":")
    with socket.create_connection((host, int(port)), timeout=30) as connection:
        connection.sendall(data)
        received = b""
        while len(received) < len(data):
            received += connection.recv(1 << 16)
    return received


def test_a_machine_is_listed_runs_answers_and_is_ended_for_good(local):
    id = local.launch()
    listed = local.machine(id)
    assert listed is not None
    assert listed.phase in (MachinePhase.PROVISIONING, MachinePhase.RUNNING)
    machine = local.wait(id, MachinePhase.RUNNING)
    assert (machine.placement.location, machine.spec_hash) == ("local/us-west-1/a", "abc")
    assert (machine.usd_per_hour, machine.notice, machine.failure) == (0.07, False, None)
    assert echo(machine.endpoint) == HELLO

    what_is_secret_is_readable_by_its_owner_only(local.folder(id))
    terminate_leaves_nothing_but_the_log(local, id)
    local.cloud.terminate(id)  # it may be repeated, and asked for what never was
    local.cloud.terminate(ReplicaId(local.uid, 99, 1))
    assert local.cloud.machines(local.uid) == []
    local.cloud.launch(local.order())  # of a superseded manager, late
    assert local.machine(id) is None, "an ended machine is never launched again"
    assert processes.find(machine=str(id)) == []


def what_is_secret_is_readable_by_its_owner_only(folder):
    modes = {p.name: stat.S_IMODE(p.stat().st_mode) for p in folder.iterdir()}
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    for name in ("replica.key", "replica.yaml", "machine.json", "state.json", "machine.log"):
        assert modes[name] == 0o600, name


def terminate_leaves_nothing_but_the_log(local, id):
    assert processes.find(machine=str(id))
    local.given(id)
    local.cloud.terminate(id)
    assert processes.find(machine=str(id)) == []
    assert local.machine(id) is None
    assert os.listdir(local.root / "machines") == []
    log = local.cloud.log(id)
    assert log is not None
    assert "stand-in begins" in Path(log).read_text()


def test_the_server_gets_its_place_its_files_and_marks_in_its_environment(local, tmp_path):
    envs = {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp", "EMPTY": None, "PYTHONPATH": "/extra"}
    id = local.running(task={"workdir": str(tmp_path), "envs": envs}).id
    given = local.given(id)
    folder = local.folder(id)
    assert given["config"] == str(folder / "replica.yaml")
    assert given["notice_file"] == str(folder / "notice.json")
    assert given["workdir"] == str(tmp_path)
    assert 1 <= int(given["domain_id"]) <= 101
    assert given["environ"]["FOGFT_MACHINE"] == str(id)
    assert given["environ"]["FOGFT_POOL_UID"] == local.uid
    # As on a VM: the proxy would not understand its service on another middleware.
    assert given["environ"]["RMW_IMPLEMENTATION"] == "rmw_cyclonedds_cpp"
    assert not given["environ"]["EMPTY"]
    first, *others = given["environ"]["PYTHONPATH"].split(os.pathsep)
    assert first == "/extra"
    assert others, "where fogft itself lies"


def test_machines_have_different_domains_and_not_the_robots(local, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    ids = [local.launch(slot) for slot in range(4)]
    domains = [int(local.given(id)["domain_id"]) for id in ids]
    assert len(set(domains)) == 4
    assert 7 not in domains


def test_terminate_while_booting(local):
    id = local.launch(where="slow-1/a")
    wait_for(lambda: local.machine(id).progress == "booting")
    (local.folder(id) / "state.json").unlink()  # as before its process has started
    assert local.machine(id).progress == "ordered"
    local.cloud.terminate(id)
    assert local.machine(id) is None
    assert processes.find(machine=str(id)) == []


def test_launching_twice_is_launching_once(local):
    order = local.order()
    local.cloud.launch(order)
    local.cloud.launch(order)
    machine = local.wait(order.id, MachinePhase.RUNNING)
    local.cloud.launch(order)
    state = json.loads((local.folder(order.id) / "state.json").read_text())
    wait_for(lambda: set(processes.find(machine=str(order.id))) == set(state["pids"].values()))
    assert local.machine(order.id) == machine


def test_setup_runs_before_the_server_in_the_workdir_with_its_variables(local, tmp_path):
    task = {
        "workdir": str(tmp_path),
        "setup": "pwd > where; echo $A$B > what",
        "envs": {"A": "x", "B": 1},
    }
    local.running(task=task)
    assert (tmp_path / "where").read_text().strip() == str(tmp_path)
    assert (tmp_path / "what").read_text().strip() == "x1"


def test_setups_in_one_folder_take_turns(local, tmp_path):
    """Machines share the workdir: two builds in it at once would clash."""
    setup = "mkdir busy && sleep 0.1 && rmdir busy"
    task = {"workdir": str(tmp_path), "setup": setup}
    ids = [local.launch(slot, task=task) for slot in range(3)]
    for id in ids:
        assert local.wait(id, MachinePhase.RUNNING).failure is None


def test_a_failed_setup_is_listed_with_its_last_words_until_terminated(local):
    id = local.launch(task={"setup": "echo no compiler; exit 3"})
    failed = local.wait(id, MachinePhase.FAILED)
    assert failed.failure == Reason(Cause.SETUP, words="exited with status 3\nno compiler")
    wait_for(lambda: not processes.find(machine=str(id)))
    assert local.machine(id) == failed
    local.cloud.terminate(id)
    assert local.machine(id) is None


def test_a_server_that_never_listens_is_a_failed_launch(local):
    id = local.launch(exit=4)
    failure = local.wait(id, MachinePhase.FAILED).failure
    assert failure.cause is Cause.ERROR
    assert "stand-in cannot go on" in failure.words


def test_a_missing_workdir_is_a_failed_launch(local, tmp_path):
    id = local.launch(task={"workdir": str(tmp_path / "none")})
    failure = local.wait(id, MachinePhase.FAILED).failure
    assert failure.cause is Cause.SETUP  # other zones would be no better
    assert "workdir" in failure.words


def test_a_machine_ends_with_its_server(local):
    machine = local.running()
    echo(machine.endpoint)
    state = json.loads((local.folder(machine.id) / "state.json").read_text())
    os.kill(state["pids"]["serve"], 9)
    local.wait_gone(machine.id)
    log = Path(local.cloud.log(machine.id)).read_text()
    assert "was killed by SIGKILL" in log
    assert "Task was destroyed" not in log


def test_connections_wait_for_a_server_that_is_still_starting(local):
    """A link that is opened while the machine boots is up as soon as the server listens."""
    machine = local.running()
    results = []
    threads = [
        threading.Thread(target=lambda: results.append(echo(machine.endpoint))) for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == [HELLO] * 3


def test_without_a_relay_the_server_listens_at_the_endpoint(local):
    (local.root / "regions.yaml").write_text("relay: false\nboot_s: 0.01\n")
    machine = local.running()
    assert local.given(machine.id)["listen"] == machine.endpoint
    with pytest.raises(CloudError, match="no relay"):
        local.chaos.slow(machine.id, 0.1)


def test_capacity_is_what_the_zone_says(local):
    local.launch(0, where="us-west-2/a")
    local.launch(1, where="us-west-2/a")
    with pytest.raises(NoCapacity, match="2 of 2"):
        local.launch(2, where="us-west-2/a")
    assert len(local.cloud.machines(local.uid)) == 2
    local.cloud.terminate(local.order(0).id)
    local.launch(3, where="us-west-2/a")


def test_a_zone_that_does_not_exist_is_refused(local):
    with pytest.raises(CloudError, match="no zone `local/us-west-1/z`"):
        local.launch(where="us-west-1/z")
    assert local.cloud.machines(local.uid) == []


@pytest.mark.parametrize("name", ["../x", "machine.json", "lock", "a/b", ".hidden"])
def test_an_order_cannot_write_outside_its_folder_or_over_our_files(local, name):
    order = local.order()
    bad = type(order)(**{**vars(order), "files": {name: b""}})
    with pytest.raises(CloudError, match="file named"):
        local.cloud.launch(bad)
    assert local.cloud.machines(local.uid) == []


def test_pools_do_not_see_each_other(local):
    id = local.launch()
    assert local.cloud.machines("0" * 16) == []
    assert local.machine(id) is not None


def test_logs_of_ended_machines_are_bounded(local, monkeypatch):
    monkeypatch.setattr(ending, "LOGS_KEPT", 2)
    ids = []
    for slot in range(3):
        ids.append(local.running(slot).id)
        local.cloud.terminate(ids[-1])
    assert [local.cloud.log(id) is not None for id in ids] == [False, True, True]


# -- what may lie in the folder


@pytest.mark.parametrize("content", ["", "{", "[]", '{"id": 3}', "null", "\x00\xff"])
def test_garbage_in_one_folder_does_not_hide_the_others(local, caplog, content):
    """A damaged folder is nobody's machine; the others are listed as ever."""
    good = local.launch(0)
    bad = local.folder(ReplicaId(local.uid, 1, 1))
    bad.mkdir()
    (bad / "machine.json").write_text(content)
    (bad / "replica.key").write_text("secret")
    (bad.parent / "README").write_text("not a machine")
    assert [m.id for m in local.cloud.machines(local.uid)] == [good]
    assert local.cloud.machines("1" * 16) == []
    warned = [r.message for r in caplog.records if "machine_ignored" in r.message]
    assert len(warned) == 2, "each is told once"
    local.cloud.machines(local.uid)
    assert len([r for r in caplog.records if "machine_ignored" in r.message]) == 2
    assert not bad.exists(), "no key stays of what a power cut left"


def test_a_living_machine_with_a_damaged_record_is_listed_so_that_it_can_be_ended(local):
    """What runs is never forgotten, whatever becomes of its files."""
    id = local.running().id
    (local.folder(id) / folders.RECORD).write_text("{")
    machine = local.machine(id)
    assert machine.phase is MachinePhase.FAILED
    assert machine.failure.cause is Cause.ERROR
    local.cloud.terminate(id)
    assert processes.find(machine=str(id)) == []


def test_a_machine_whose_folder_was_removed_ends(local):
    """Nobody could list it any more: it must not run for ever."""
    id = local.running().id
    while local.root.exists():  # the machine may write meanwhile
        shutil.rmtree(local.root, ignore_errors=True)
    wait_for(lambda: not processes.find(machine=str(id)))


def test_a_damaged_notice_ends_nobody(local):
    id = local.running().id
    for name in (folders.NOTICE, folders.END):
        (local.folder(id) / name).write_text("{")
    local.chaos.slow(id, 0.01)  # it looks at its files in turn, this one last
    wait_for(lambda: "link_changed" in Path(local.cloud.log(id)).read_text())
    assert local.machine(id).phase is MachinePhase.RUNNING
    local.cloud.terminate(id)
    assert local.machine(id) is None
